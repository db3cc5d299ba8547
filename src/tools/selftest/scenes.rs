//! Small deterministic test scenes in front of a camera in general position.

use densify_core::camera::Camera;
use densify_core::gaussians::{Gaussians, sh_coefficients};
use densify_core::image::Image8;
use densify_render::ImageGradient;
use densify_render::Rendering;
use glam::{DMat3, DQuat, DVec3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::reference::Upstream;

/// A camera with an arbitrary pose and a principal point off the centre of the image.
pub fn camera(width: u32, height: u32, seed: u64) -> Camera {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut number = || rng.random_range(-1.0..1.0);
    let pose = DQuat::from_xyzw(number(), number(), number(), 1.5 + number()).normalize();
    let size = f64::from(width.max(height));
    let camera = Camera {
        width,
        height,
        fx: size * (1.0 + 0.1 * number()),
        fy: size * (1.0 + 0.1 * number()),
        cx: f64::from(width) * (0.5 + 0.05 * number()),
        cy: f64::from(height) * (0.5 + 0.05 * number()),
        rotation: DMat3::from_quat(pose),
        translation: DVec3::new(number(), number(), number()),
    };
    rounded(&camera)
}

/// The camera with every number rounded to `f32`, so that backends and reference start from the same values.
pub fn rounded(camera: &Camera) -> Camera {
    let round = |v: f64| f64::from(v as f32);
    Camera {
        fx: round(camera.fx),
        fy: round(camera.fy),
        cx: round(camera.cx),
        cy: round(camera.cy),
        rotation: DMat3::from_cols_array(&camera.rotation.to_cols_array().map(round)),
        translation: DVec3::from(camera.translation.to_array().map(round)),
        ..*camera
    }
}

/// World position of a point in camera coordinates.
pub fn world(camera: &Camera, local: [f64; 3]) -> [f32; 3] {
    let world = camera.rotation.inverse() * (DVec3::from(local) - camera.translation);
    world.to_array().map(|v| v as f32)
}

/// Appends a row to `model`.
pub fn push(
    model: &mut Gaussians,
    mean: [f32; 3],
    scale: [f32; 3],
    quat: [f32; 4],
    opacity_logit: f32,
    sh: impl FnMut(usize) -> f32,
) {
    model.means.push(mean);
    model.log_scales.push(scale.map(f32::ln));
    model.quats.push(quat);
    model.opacity_logits.push(opacity_logit);
    model.sh.extend((0..3 * sh_coefficients(model.sh_degree)).map(sh));
}

/// `rows` translucent Gaussians over the image and a little beyond, 2 to 40 % of the image wide, with
/// quaternions of any length. Depths lie between 2 and 5 and differ by more than rounding.
pub fn cloud(rows: usize, sh_degree: u8, camera: &Camera, seed: u64) -> Gaussians {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut model = Gaussians { sh_degree, ..Gaussians::default() };
    let mut order: Vec<usize> = (0..rows).collect();
    for i in (1..rows).rev() {
        order.swap(i, rng.random_range(0..=i));
    }
    for rank in order {
        let z = 2.0 + 3.0 * (rank as f64 + rng.random_range(0.2..0.8)) / rows as f64;
        let u = f64::from(camera.width) * rng.random_range(-0.1..1.1);
        let v = f64::from(camera.height) * rng.random_range(-0.1..1.1);
        let local = [(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z];
        let scale = [(); 3].map(|()| (z * 0.02 * 20.0_f64.powf(rng.random())) as f32);
        let quat = [(); 4].map(|()| rng.random_range(-1.0_f32..1.0));
        let logit = rng.random_range(-2.0..2.0);
        push(&mut model, world(camera, local), scale, quat, logit, |k| {
            rng.random_range(-0.5_f32..0.5) * if k < 3 { 1.5 } else { 0.5 }
        });
    }
    model
}

/// One row at a point in camera coordinates, with a view-dependent colour (degree 1).
pub fn one_at(camera: &Camera, local: [f64; 3], scale: [f32; 3]) -> Gaussians {
    let mut model = Gaussians { sh_degree: 1, ..Gaussians::default() };
    let quat = [0.9, -0.3, 0.4, 0.2];
    push(&mut model, world(camera, local), scale, quat, 1.0, |k| 0.3 - 0.05 * k as f32);
    model
}

/// A photograph of the camera's size in which neighbouring pixels differ.
pub fn target(camera: &Camera) -> Image8 {
    let n = 3 * camera.width * camera.height;
    let rgb = (0..n).map(|i| (i * 37 % 251) as u8).collect();
    Image8 { width: camera.width, height: camera.height, rgb, alpha: None, mask: None }
}

/// dL/d(image) of a loss with random weights of both signs on every pixel.
pub fn upstream(camera: &Camera, seed: u64) -> Upstream {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let pixels = (camera.width * camera.height) as usize;
    // Rounded to f32, as a backend takes them.
    let mut noise = |n: usize, scale: f32| -> Vec<f64> {
        (0..n).map(|_| f64::from(scale * rng.random_range(-1.0_f32..1.0))).collect()
    };
    Upstream { rgb: noise(3 * pixels, 1.0), alpha: noise(pixels, 1.0), depth: noise(pixels, 0.3) }
}

/// The gradient in `f32`, as backends take it.
pub fn narrowed(upstream: &Upstream) -> ImageGradient {
    let narrow = |values: &[f64]| values.iter().map(|&v| v as f32).collect();
    ImageGradient {
        rgb: narrow(&upstream.rgb),
        alpha: narrow(&upstream.alpha),
        depth: narrow(&upstream.depth),
    }
}

/// A noisy rendering of a random photograph, and the photograph.
pub fn noisy((width, height): (u32, u32), noise: f32, seed: u64) -> (Vec<f32>, Image8) {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let n = 3 * (width * height) as usize;
    let rgb: Vec<u8> = (0..n).map(|_| rng.random()).collect();
    let rendered = rgb
        .iter()
        .map(|&v| f32::from(v) / 255.0 + noise * rng.random_range(-1.0_f32..1.0))
        .collect();
    (rendered, Image8 { width, height, rgb, alpha: None, mask: None })
}

/// A rendering with these colours and the photograph's size: opaque, at depth 1.
pub fn opaque(rgb: &[f32], target: &Image8) -> Rendering {
    let pixels = rgb.len() / 3;
    Rendering {
        width: target.width,
        height: target.height,
        rgb: rgb.to_vec(),
        alpha: vec![1.0; pixels],
        depth: vec![1.0; pixels],
    }
}
