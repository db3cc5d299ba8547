//! A small test dataset: a ring of cameras around a few Gaussians, rendered by the library and written to disk in
//! several dataset formats.

use std::f64::consts::TAU;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use densify::core::camera::Camera;
use densify::core::gaussians::{Gaussians, logit, rgb_to_dc};
use glam::{DMat3, DQuat, DVec3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::json;
use tempfile::TempDir;

use crate::subject::make;
use densify::selftest::{Subject, scenes};

/// Number of views.
pub(crate) const VIEWS: usize = 14;
/// Width and height [px].
pub(crate) const SIZE: (u32, u32) = (48, 40);
/// Number of points of the reconstruction.
pub(crate) const POINTS: usize = 300;
const FOCAL: f64 = 52.0;
const BLOBS: usize = 24;

/// A rendered photograph.
struct Shot {
    camera: Camera,
    /// Colour on black. Shape: [height, width, 3].
    rgb: Vec<f32>,
    alpha: Vec<f32>,
}

/// A dataset in a temporary folder, which is removed on drop.
pub(crate) struct Photographs {
    folder: TempDir,
}

pub(crate) fn name(view: usize) -> String {
    format!("view_{view:02}.png")
}

fn blobs() -> Gaussians {
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let mut model = Gaussians::default();
    for _ in 0..BLOBS {
        let mean = [(); 3].map(|()| rng.random_range(-1.0_f32..1.0));
        let scale = [(); 3].map(|()| rng.random_range(0.12_f32..0.35));
        let quat = [(); 4].map(|()| rng.random_range(-1.0_f32..1.0));
        scenes::push(&mut model, mean, scale, quat, logit(0.9), |_| {
            rgb_to_dc(rng.random_range(0.05..0.95))
        });
    }
    model
}

/// Points on the blobs: (position, colour).
fn points() -> Vec<([f64; 3], [u8; 3])> {
    let model = blobs();
    let mut rng = ChaCha8Rng::seed_from_u64(6);
    let point = |i: usize| {
        let row = i % BLOBS;
        let near = |axis: usize| {
            f64::from(model.means[row][axis]) + 0.25 * rng.random_range(-1.0_f64..1.0)
        };
        let dc = model.sh_of(row);
        let colour = [0, 1, 2].map(|c| (255.0 * (0.5 + densify::core::sh::C0 * dc[c])) as u8);
        ([0, 1, 2].map(near), colour)
    };
    (0..POINTS).map(point).collect()
}

/// A camera of the ring that looks at the origin.
pub(crate) fn camera(view: usize) -> Camera {
    let angle = TAU * view as f64 / VIEWS as f64;
    let height = [0.9, -0.4, 0.2][view % 3];
    let centre = DVec3::new(4.0 * angle.sin(), height, 4.0 * angle.cos());
    let forward = -centre.normalize();
    let right = DVec3::Y.cross(forward).normalize();
    let rotation = DMat3::from_cols(right, forward.cross(right), forward).transpose();
    let (width, height) = SIZE;
    Camera {
        width,
        height,
        fx: FOCAL,
        fy: FOCAL,
        cx: 0.5 * f64::from(width),
        cy: 0.5 * f64::from(height),
        rotation,
        translation: -(rotation * centre),
    }
}

fn shots() -> &'static [Shot] {
    static SHOTS: OnceLock<Vec<Shot>> = OnceLock::new();
    SHOTS.get_or_init(|| {
        let mut backend = make(&Subject::NATIVE, &blobs());
        let shoot = |view: usize| {
            let camera = camera(view);
            let image = backend.render(&camera, [0.0; 3], 0).expect("a small image is rendered");
            Shot { camera, rgb: image.rgb, alpha: image.alpha }
        };
        (0..VIEWS).map(shoot).collect()
    })
}

fn to_u8(value: f32) -> u8 {
    (value.clamp(0.0, 1.0) * 255.0).round() as u8
}

impl Photographs {
    fn empty() -> Self {
        Self { folder: tempfile::tempdir().expect("a temporary folder") }
    }

    fn with_images() -> Self {
        let made = Self::empty();
        for (view, shot) in shots().iter().enumerate() {
            let rgb = shot.rgb.iter().map(|&v| to_u8(v)).collect();
            let image = image::RgbImage::from_raw(SIZE.0, SIZE.1, rgb).expect("its size");
            made.save(&format!("images/{}", name(view)), |path| image.save(path));
        }
        made
    }

    /// A COLMAP text model.
    pub(crate) fn colmap_text() -> Self {
        Self::colmap_text_at(DVec3::ZERO)
    }

    /// The same model, shifted by `place`.
    pub(crate) fn colmap_text_at(place: DVec3) -> Self {
        let made = Self::with_images();
        let (width, height) = SIZE;
        let camera = format!("1 PINHOLE {width} {height} {FOCAL} {FOCAL} 24 20\n");
        made.write("sparse/0/cameras.txt", camera);
        let mut images = String::new();
        for (view, Shot { camera, .. }) in shots().iter().enumerate() {
            let q = DQuat::from_mat3(&camera.rotation);
            let t = camera.translation - camera.rotation * place;
            let pose = [q.w, q.x, q.y, q.z, t.x, t.y, t.z].map(|number| number.to_string());
            images += &format!("{} {} 1 {}\n\n", view + 1, pose.join(" "), name(view));
        }
        made.write("sparse/0/images.txt", images);
        let mut lines = String::new();
        for (id, ([x, y, z], [r, g, b])) in points().into_iter().enumerate() {
            let [x, y, z] = (DVec3::new(x, y, z) + place).to_array();
            lines += &format!("{} {x} {y} {z} {r} {g} {b} 0.5\n", id + 1);
        }
        made.write("sparse/0/points3D.txt", lines);
        made
    }

    /// A NeRF-synthetic scene: transparent images, every 7th in the test file, no points.
    pub(crate) fn transforms() -> Self {
        let made = Self::empty();
        for held_out in [false, true] {
            let split = if held_out { "test" } else { "train" };
            let views = (0..VIEWS).filter(|view| (view % 7 == 0) == held_out);
            let frames: Vec<_> = views.map(|view| made.frame(split, view)).collect();
            let angle = 2.0 * (0.5 * f64::from(SIZE.0) / FOCAL).atan();
            let listing = json!({ "camera_angle_x": angle, "frames": frames });
            made.write(&format!("transforms_{split}.json"), listing.to_string());
        }
        made
    }

    /// Saves a view with transparency and returns its entry.
    fn frame(&self, split: &str, view: usize) -> serde_json::Value {
        let Shot { camera, rgb, alpha } = &shots()[view];
        let pixel = |x: u32, y: u32| {
            let at = (y * SIZE.0 + x) as usize;
            let cover = alpha[at].max(1e-3);
            let [r, g, b] = [0, 1, 2].map(|c| to_u8(rgb[3 * at + c] / cover));
            image::Rgba([r, g, b, to_u8(alpha[at])])
        };
        let image = image::RgbaImage::from_fn(SIZE.0, SIZE.1, pixel);
        self.save(&format!("{split}/r_{view}.png"), |path| image.save(path));
        // OpenGL axes: x right, y up, z backward; camera to world.
        let axes = camera.rotation.transpose();
        let (x, y, z, at) = (axes.x_axis, -axes.y_axis, -axes.z_axis, camera.centre());
        let row = |i: usize| [x[i], y[i], z[i], at[i]];
        json!({
            "file_path": format!("./{split}/r_{view}"),
            "transform_matrix": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]],
        })
    }

    pub(crate) fn path(&self) -> &Path {
        self.folder.path()
    }

    pub(crate) fn file(&self, name: &str) -> PathBuf {
        self.path().join(name)
    }

    pub(crate) fn write(&self, name: &str, contents: impl AsRef<[u8]>) {
        self.save(name, |path| std::fs::write(path, contents));
    }

    fn save<E: std::fmt::Debug>(&self, name: &str, save: impl FnOnce(&Path) -> Result<(), E>) {
        let path = self.file(name);
        std::fs::create_dir_all(path.parent().expect("a file in a folder")).expect("a folder");
        save(&path).expect("a file in a temporary folder");
    }

    /// Replaces the first occurrence of `old` in a text file.
    pub(crate) fn replace(&self, name: &str, old: &str, new: &str) {
        let text = std::fs::read_to_string(self.file(name)).expect("a file of the dataset");
        assert!(text.contains(old), "{name} has no {old:?}");
        self.write(name, text.replacen(old, new, 1));
    }

    /// Cuts `bytes` off the end of a file.
    pub(crate) fn truncate(&self, name: &str, bytes: usize) {
        let contents = std::fs::read(self.file(name)).expect("a file of the dataset");
        self.write(name, &contents[..contents.len() - bytes]);
    }
}
