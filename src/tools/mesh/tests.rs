//! Tests of fusion: a sphere, whose surface is known exactly, and a room, whose true depth must give the true surface.

use std::collections::HashMap;

use densify_core::camera::Camera;
use densify_data::dataset::normalise::Normalisation;
use densify_data::meshes;
use densify_run::Silent;
use densify_run::failure::Failure;
use densify_scenegen::{GroundTruth, Options, Scene, Source};
use densify_train::metrics::geometry::{KnownScene, MeshErrors, measure_mesh};
use glam::{DMat3, DVec3, Vec3};

use super::*;

/// A sphere around the origin, seen from all sides.
struct Sphere {
    radius: f64,
    cameras: Vec<Camera>,
}

impl Sphere {
    fn new(radius: f64) -> Self {
        // The sides and the corners of a cube.
        let directions = [1.0, -1.0].into_iter().flat_map(|sign| {
            let corner = |x: f64, y: f64| DVec3::new(x, y, 1.0).normalize();
            let corners =
                [corner(1.0, 1.0), corner(-1.0, 1.0), corner(1.0, -1.0), corner(-1.0, -1.0)];
            let sides = [DVec3::X, DVec3::Y, DVec3::Z].into_iter();
            sides.chain(corners).map(move |direction| sign * direction)
        });
        let camera = |direction: DVec3| {
            let (x, y) = (-direction).any_orthonormal_pair();
            let rotation = DMat3::from_cols(x, y, -direction).transpose();
            Camera::centred((90, 80), (110.0, 110.0), rotation, 3.0 * direction)
        };
        Self { radius, cameras: directions.map(camera).collect() }
    }
}

/// The colour at a point of the sphere.
fn colour(point: DVec3) -> [u8; 3] {
    (point * 100.0 + 128.0).to_array().map(|value| value.round() as u8)
}

impl DepthSource for Sphere {
    fn count(&self) -> usize {
        self.cameras.len()
    }

    fn camera(&self, view: usize) -> Camera {
        self.cameras[view]
    }

    fn frame(&mut self, view: usize) -> Result<DepthFrame, Failure> {
        let camera = self.cameras[view];
        let (width, height) = (camera.width as usize, camera.height as usize);
        let (mut depth, mut rgb) = (Vec::new(), Vec::new());
        for at in 0..width * height {
            let pixel = DVec3::new((at % width) as f64 + 0.5, (at / width) as f64 + 0.5, 0.0);
            let ray = DVec3::new(
                (pixel.x - camera.cx) / camera.fx,
                (pixel.y - camera.cy) / camera.fy,
                1.0,
            );
            let (centre, ray) = (camera.centre(), camera.rotation.transpose() * ray);
            let (a, b) = (ray.length_squared(), centre.dot(ray));
            let root = b * b - a * (centre.length_squared() - self.radius * self.radius);
            let z = if root > 0.0 { (-b - root.sqrt()) / a } else { 0.0 };
            depth.push(z as f32);
            rgb.push(if z > 0.0 { colour(centre + ray * z) } else { [0; 3] });
        }
        Ok(DepthFrame { width, height, depth, rgb })
    }
}

const SPHERE: FuseOptions = FuseOptions {
    voxel: Some(0.05),
    region: None,
    min_component: 0.001,
    memory: 1 << 30,
    unit: 1.0,
};

fn fused(options: &FuseOptions) -> Result<Fused, MeshError> {
    fuse(&mut Sphere::new(1.0), options, &Silent)
}

#[test]
fn a_sphere_becomes_a_closed_surface_of_its_colours() {
    let Fused { mesh, passes, dropped, .. } = fused(&SPHERE).unwrap();
    assert_eq!((passes, dropped.0), (1, 0));
    // Each edge belongs to two triangles, in opposite directions.
    let mut edges: HashMap<(u32, u32), i32> = HashMap::new();
    for [a, b, c] in &mesh.triangles {
        for (from, to) in [(a, b), (b, c), (c, a)] {
            *edges.entry((*from, *to)).or_default() += 1;
        }
    }
    for (&(from, to), &count) in &edges {
        assert_eq!((count, edges.get(&(to, from))), (1, Some(&1)), "edge {from}-{to}");
    }
    let volume: f64 = mesh.corners().iter().map(|[a, b, c]| a.dot(b.cross(*c)) / 6.0).sum();
    let exact = 4.0 / 3.0 * std::f64::consts::PI;
    assert!((volume / exact - 1.0).abs() < 0.01, "{volume}, expected {exact}");
    for vertex in 0..mesh.positions.len() {
        let place = mesh.place_of(vertex);
        assert!((place.length() - 1.0).abs() < 0.2 * 0.05, "{place} is off the surface");
        for (found, expected) in mesh.colours[vertex].into_iter().zip(colour(place.normalize())) {
            assert!(found.abs_diff(expected) <= 4, "{found} at {place}, expected {expected}");
        }
    }
}

#[test]
fn passes_and_threads_change_nothing() {
    let whole = fused(&SPHERE).unwrap();
    assert!(whole.blocks > 200, "{}", whole.blocks);
    let small = fused(&FuseOptions { memory: 5 << 18, ..SPHERE }).unwrap();
    assert!(small.passes > 2, "{}", small.passes);
    assert!(small.mesh == whole.mesh);
    for threads in [1, 3] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        assert!(pool.install(|| fused(&SPHERE)).unwrap().mesh == whole.mesh, "{threads} threads");
    }
}

#[test]
fn what_cannot_be_fused_is_refused() {
    let small = fused(&FuseOptions { memory: 300 << 10, ..SPHERE }).unwrap_err();
    assert!(small.to_string().contains("the memory is too small for voxels of 0.05"), "{small}");
    let tiny = fused(&FuseOptions { voxel: Some(1e-7), ..SPHERE });
    assert!(matches!(tiny, Err(MeshError::TooFine { .. })), "{tiny:?}");
    let fine = fused(&FuseOptions { voxel: Some(1e-4), memory: 4 << 20, ..SPHERE });
    assert!(matches!(fine, Err(MeshError::Memory { part: "the list of blocks", .. })), "{fine:?}");
    let beside = Region { low: DVec3::splat(2.0), high: DVec3::splat(2.5) };
    let nothing = fused(&FuseOptions { region: Some(beside), ..SPHERE });
    assert_eq!(nothing, Err(MeshError::Nothing));
}

#[test]
fn a_region_cuts_the_surface() {
    let upper = Region { low: DVec3::new(-2.0, 0.3, -2.0), high: DVec3::splat(2.0) };
    let cut = fused(&FuseOptions { region: Some(upper), ..SPHERE }).unwrap().mesh;
    let lowest = (0..cut.positions.len()).map(|i| cut.place_of(i).y).fold(9.0, f64::min);
    assert!((0.3..0.36).contains(&lowest), "{lowest}");
    // The upper sides are kept as well, wherever they are within a block.
    for y in [-0.62, 0.11, 0.3] {
        let high = DVec3::new(2.0, y, 0.5);
        let region = Region { low: DVec3::splat(-2.0), high };
        let cut = fused(&FuseOptions { region: Some(region), ..SPHERE }).unwrap().mesh;
        let places = (0..cut.positions.len()).map(|i| cut.place_of(i));
        let highest = places.reduce(DVec3::max).unwrap();
        for axis in [1, 2] {
            let beyond = highest[axis] - high[axis];
            assert!((-0.1..1e-6).contains(&beyond), "{highest}, {high}");
        }
    }
}

#[test]
fn small_components_are_dropped() {
    // A second sphere with 1/150 of the area.
    struct Two(Sphere, Sphere);
    impl DepthSource for Two {
        fn count(&self) -> usize {
            self.0.count()
        }
        fn camera(&self, view: usize) -> Camera {
            self.0.camera(view)
        }
        fn frame(&mut self, view: usize) -> Result<DepthFrame, Failure> {
            let mut frame = self.0.frame(view)?;
            // The small sphere at (0, 1.2, 0) is rendered with cameras moved the other way.
            let small = self.1.frame(view)?;
            for at in 0..frame.depth.len() {
                let (near, far) = (small.depth[at], frame.depth[at]);
                if near > 0.0 && (far <= 0.0 || near < far) {
                    (frame.depth[at], frame.rgb[at]) = (near, small.rgb[at]);
                }
            }
            Ok(frame)
        }
    }
    let mut beside = Sphere::new(0.08);
    for camera in &mut beside.cameras {
        camera.translation += camera.rotation * DVec3::new(0.0, 1.2, 0.0);
    }
    let mut two = Two(Sphere::new(1.0), beside);
    let options = FuseOptions { voxel: Some(0.025), ..SPHERE };
    let dropped = |min_component: f64, two: &mut Two| {
        let fused = fuse(two, &FuseOptions { min_component, ..options }, &Silent).unwrap();
        let far = |i: usize| fused.mesh.place_of(i).length() > 1.1;
        (fused.dropped, (0..fused.mesh.positions.len()).any(far))
    };
    let ((count, share), any_far) = dropped(0.05, &mut two);
    assert!(count >= 1 && (0.003..0.02).contains(&share) && !any_far, "{count}, {share}");
    let ((_, share), any_far) = dropped(0.001, &mut two);
    assert!(share < 0.002 && any_far, "{share}");
}

#[test]
#[allow(clippy::float_cmp, reason = "exact values")]
fn files_are_read_back_as_they_were() {
    let folder = tempfile::tempdir().unwrap();
    let mesh = fused(&SPHERE).unwrap().mesh;
    for (offset, scale) in [(DVec3::ZERO, 1.0), (DVec3::new(431_000.25, 5_414_000.5, 212.0), 0.02)]
    {
        let world = Normalisation { centre: offset, scale };
        let mesh = mesh.clone().in_world(&world);
        let tolerance = 0.01 * mesh.scale;
        for (name, format) in
            [("a.ply", MeshFormat::Ply), ("a.GLB", MeshFormat::Glb), ("a.obj", MeshFormat::Obj)]
        {
            let path = folder.path().join(name);
            assert_eq!(MeshFormat::of_file(&path), Some(format));
            format.write(&mesh, &path).unwrap();
            assert!(meshes::is_mesh(&path), "{name}");
            let read = meshes::read(&path).unwrap();
            assert_eq!(read.triangles.len(), mesh.triangles.len(), "{name}");
            for (found, expected) in read.triangles.iter().zip(&mesh.triangles) {
                for (&found, &expected) in found.iter().zip(expected) {
                    let found = read.positions[found as usize];
                    let expected = mesh.place_of(expected as usize);
                    assert!(found.distance(expected) < tolerance, "{name}: {found}, {expected}");
                }
            }
            if name != "a.ply" {
                // Colours are linear in memory.
                let encode = densify_scenegen::texture::srgb_from_linear;
                let corner = (read.triangles[0][0], mesh.triangles[0][0]);
                let found = read.colours[corner.0 as usize].truncate();
                let found = Vec3::to_array(&found).map(|v| encode(v.into()) * 255.0);
                for (found, expected) in found.into_iter().zip(mesh.colours[corner.1 as usize]) {
                    assert!((found - f64::from(expected)).abs() < 0.51, "{name}: {found}");
                }
            }
        }
    }
    assert_eq!(MeshFormat::of_file("a.stl".as_ref()), None);
}

/// The true depth of a built-in scene.
struct Truth {
    truth: GroundTruth,
    cameras: Vec<densify_scenegen::Camera>,
}

impl Truth {
    fn of_room(size: u32, views: u32) -> Self {
        let options =
            Options { size: Some((size, size)), train: Some(views), ..Options::default() };
        let scene = Scene::prepare(&Source::Preset("room".to_owned()), &options).unwrap();
        let views = scene.views.iter().take(views as usize);
        let cameras = views.map(|view| view.camera).collect();
        Self { truth: GroundTruth::of_scene(scene), cameras }
    }

    fn errors(&self, mesh: &Mesh) -> MeshErrors {
        let scene = KnownScene {
            truth: &self.truth,
            normalisation: &Normalisation::IDENTITY,
            background: [0.0; 3],
            sh_degree: 0,
            is_stopped: &|| false,
        };
        let model = densify_scenegen::mesh::Model {
            positions: (0..mesh.positions.len()).map(|i| mesh.place_of(i)).collect(),
            triangles: mesh.triangles.clone(),
            ..Default::default()
        };
        let cameras: Vec<Camera> = (0..self.cameras.len()).map(|view| self.camera(view)).collect();
        measure_mesh(&model, &scene, &cameras).unwrap()
    }
}

impl DepthSource for Truth {
    fn count(&self) -> usize {
        self.cameras.len()
    }

    fn camera(&self, view: usize) -> Camera {
        let from = &self.cameras[view];
        Camera {
            cx: from.cx,
            cy: from.cy,
            ..Camera::centred(
                (from.width, from.height),
                (from.fx, from.fy),
                from.world_from_camera.transpose(),
                from.centre,
            )
        }
    }

    fn frame(&mut self, view: usize) -> Result<DepthFrame, Failure> {
        let g_buffer = self.truth.g_buffer("", &self.cameras[view]).map_err(Failure::input)?;
        let (width, height) = (g_buffer.width as usize, g_buffer.height as usize);
        let rgb = vec![[200, 100, 50]; width * height];
        Ok(DepthFrame { width, height, depth: g_buffer.depth, rgb })
    }
}

#[test]
fn true_depth_gives_the_true_surface() {
    let mut room = Truth::of_room(128, 40);
    let options =
        FuseOptions { voxel: None, region: None, min_component: 0.001, memory: 1 << 30, unit: 1.0 };
    let fused = fuse(&mut room, &options, &Silent).unwrap();
    let errors = room.errors(&fused.mesh);
    assert!(errors.f_score_one_percent >= 0.95, "{errors:?}");
}
