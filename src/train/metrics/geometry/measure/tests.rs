//! Tests of the measurements against values computed by hand: rows on, in front of and behind a square.

use std::path::Path;
use std::sync::Arc;

use glam::{DMat3, DQuat, DVec3};

use super::*;
use densify_core::gaussians::{Gaussians, logit, rgb_to_dc};
use densify_core::image::{Image8, SharedImage};
use densify_data::dataset::GroundTruth;
use densify_data::dataset::normalise::Normalisation;
use densify_data::views::ViewError;
use densify_render::Setup;
use densify_render::cpu::CpuBackend;

const WORLD: Normalisation = Normalisation { centre: DVec3::new(40.0, -7.0, 2.0), scale: 0.375 };
const DISTANCE: f64 = 3.0;
/// Diagonal of the square that the cameras look at.
const DIAGONAL: f64 = 2.0 * std::f64::consts::SQRT_2;

/// Two views with grey images of 64 px, from z = −3 towards +z, left and right of the axis.
struct Pair {
    cameras: Vec<Camera>,
    image: SharedImage,
}

impl Pair {
    fn new() -> Self {
        let camera = |x: f64| {
            let centre = DVec3::new(x, 0.0, -DISTANCE);
            Camera::centred((64, 64), (64.0, 64.0), DMat3::IDENTITY, centre)
        };
        let rgb = vec![128; 3 * 64 * 64];
        let image = Image8 { width: 64, height: 64, rgb, alpha: None, mask: None };
        let cameras = [-0.4, 0.4].map(|x| WORLD.scene_from_world_camera(&camera(x))).to_vec();
        Self { cameras, image: Arc::new(image) }
    }
}

impl ViewSource for Pair {
    fn count(&self) -> usize {
        self.cameras.len()
    }
    fn name(&self, _: usize) -> &'static str {
        "no file of that name"
    }
    fn camera(&self, view: usize) -> &Camera {
        &self.cameras[view]
    }
    fn image(&self, _: usize) -> Result<SharedImage, ViewError> {
        Ok(self.image.clone())
    }
}

/// The square |x|, |y| <= 1 at z = 0.
fn square() -> Vec<[DVec3; 3]> {
    let at = |x: f64, y: f64| DVec3::new(x, y, 0.0);
    let corners = [at(-1.0, -1.0), at(1.0, -1.0), at(1.0, 1.0), at(-1.0, 1.0)];
    [[0, 1, 2], [0, 2, 3]].map(|t| t.map(|i: usize| corners[i])).to_vec()
}

/// The triangles of a box.
fn cuboid(low: DVec3, high: DVec3) -> Vec<[DVec3; 3]> {
    let mut triangles = Vec::new();
    for axis in 0..3 {
        let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
        for end in [low, high] {
            let corner = |a: DVec3, b: DVec3| {
                let mut p = end;
                (p[u], p[v]) = (a[u], b[v]);
                p
            };
            let [a, b, c, d] =
                [corner(low, low), corner(high, low), corner(high, high), corner(low, high)];
            triangles.extend([[a, b, c], [a, c, d]]);
        }
    }
    triangles
}

/// A ground truth of triangles; those from index `thin` on are thin structures.
fn truth(triangles: &[[DVec3; 3]], thin: usize) -> GroundTruth {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("scene.json"), r#"{"generator": "densify-scenegen"}"#)
        .unwrap();
    write_mesh(&folder.path().join("mesh.ply"), triangles, thin);
    GroundTruth::open(folder.path()).unwrap().unwrap()
}

fn write_mesh(path: &Path, triangles: &[[DVec3; 3]], thin: usize) {
    let mut header = String::from("ply\nformat binary_little_endian 1.0\n");
    header += &format!("element vertex {}\n", 3 * triangles.len());
    for axis in ["x", "y", "z"] {
        header += &format!("property double {axis}\n");
    }
    header += &format!("element face {}\n", triangles.len());
    header += "property list uchar uint vertex_indices\nproperty uchar thin\nend_header\n";
    let mut bytes = header.into_bytes();
    for value in triangles.iter().flatten().flat_map(DVec3::to_array) {
        bytes.extend(value.to_le_bytes());
    }
    for i in 0..triangles.len() {
        bytes.push(3);
        (0..3).for_each(|corner| bytes.extend((3 * i as u32 + corner).to_le_bytes()));
        bytes.push(u8::from(i >= thin));
    }
    std::fs::write(path, bytes).unwrap();
}

/// Adds a grey row.
fn push(model: &mut Gaussians, place: DVec3, scale: DVec3, opacity: f32) {
    model.means.push(place.as_vec3().to_array());
    model.log_scales.push(scale.to_array().map(|s| s.ln() as f32));
    model.quats.push([1.0, 0.0, 0.0, 0.0]);
    model.opacity_logits.push(logit(opacity));
    model.sh.extend([rgb_to_dc(128.0 / 255.0); 3]);
}

/// Flat rows at z, spaced by 0.05 along both sides of the square.
fn carpet(z: f64) -> Gaussians {
    let mut model = Gaussians::default();
    for i in 0..1600 {
        let at = |i: i32| -0.975 + 0.05 * f64::from(i);
        let place = DVec3::new(at(i % 40), at(i / 40), z);
        push(&mut model, place, DVec3::new(0.03, 0.03, 0.001), 0.95);
    }
    model
}

fn measured(truth: &GroundTruth, world: &Gaussians) -> Geometry {
    let model = WORLD.model_from_world(world.clone());
    let options = Setup { needs: needs(), ..Setup::new(model.len().max(1)) };
    let mut backend = CpuBackend::new(&model, &options).unwrap();
    let scene = KnownScene {
        truth,
        normalisation: &WORLD,
        background: [0.0; 3],
        sh_degree: 0,
        is_stopped: &|| false,
    };
    measure(&mut backend, &scene, &Pair::new(), &Pair::new()).unwrap()
}

fn close(value: f64, expected: f64, tolerance: f64) {
    assert!((value - expected).abs() <= tolerance, "{value} instead of {expected}");
}

#[test]
fn rows_on_the_surface_have_no_error() {
    let g = measured(&truth(&square(), 2), &carpet(0.0));
    close(g.depth.rmse, 0.0, 1e-6);
    close(g.depth.abs_rel, 0.0, 1e-6);
    close(g.depth.coverage, 1.0, 0.0);
    close(g.normal_error, 0.0, 1e-6);
    close(g.centres.accuracy, 0.0, 1e-6);
    close(g.centres.accuracy_p95, 0.0, 1e-6);
    // In a square cell of side h, the mean distance from the middle is h (√2 + ln(1 + √2)) / 6.
    let mean = 0.05 * (2f64.sqrt() + 1f64.asinh()) / 6.0 / DIAGONAL;
    close(g.centres.completeness, mean, 0.01 * mean);
    close(g.centres.chamfer, g.centres.completeness, 1e-6);
    // The recall is the share of each cell that is within 0.5 % of the diagonal from its centre.
    let recall = std::f64::consts::PI * (0.005 * DIAGONAL / 0.05).powi(2);
    close(g.centres.f_score_half_percent, 2.0 * recall / (1.0 + recall), 0.01);
    assert_eq!((g.floaters.count, g.floaters.of_weight), (0, 0.0));
    assert!(g.thin.is_empty());
}

#[test]
fn an_offset_of_all_rows_is_measured() {
    let truth = truth(&square(), 2);
    let g = measured(&truth, &carpet(0.1));
    close(g.depth.rmse, 0.1 / DIAGONAL, 1e-6);
    close(g.depth.abs_rel, 0.1 / DISTANCE, 1e-6);
    close(g.centres.accuracy, 0.1 / DIAGONAL, 1e-6);
    close(g.centres.accuracy_p95, 0.1 / DIAGONAL, 1e-6);
    assert_eq!(g.centres.f_score_one_percent, 0.0);
    // No view sees the rows, because they are behind the surface.
    assert_eq!(g.floaters.count, 0);
    // At the same distance in front of the surface, all rows are in empty space: 0.1 > 0.01 · 2.83 and > 2 · 0.03.
    let g = measured(&truth, &carpet(-0.1));
    assert_eq!((g.floaters.count, g.floaters.of_rows), (1600, 1.0));
    close(g.floaters.of_weight, 1.0, 1e-12);
    close(g.depth.rmse, 0.1 / DIAGONAL, 1e-6);
}

#[test]
fn invisible_rows_and_surfaces_do_not_count() {
    // Rows behind the carpet have almost no weight.
    let (mut model, hidden) = (carpet(0.0), carpet(0.5));
    for row in 0..hidden.len() {
        let place = DVec3::from(hidden.means[row].map(f64::from));
        push(&mut model, place, DVec3::new(0.03, 0.03, 0.001), 0.95);
    }
    let accuracy = measured(&truth(&square(), 2), &model).centres.accuracy;
    assert!(accuracy > 0.0 && accuracy < 0.05 * 0.5 / DIAGONAL, "{accuracy}");
    // A second square behind the first needs no rows, because it is hidden from both cameras.
    let mut triangles = square();
    triangles.extend(square().into_iter().map(|t| t.map(|p| p + DVec3::Z)));
    let g = measured(&truth(&triangles, 4), &carpet(0.0));
    let mean = 0.05 * (2f64.sqrt() + 1f64.asinh()) / 6.0 / 3.0;
    close(g.centres.completeness, mean, 0.02 * mean);
}

#[test]
fn weight_before_the_surface_and_its_spread_are_measured() {
    let truth = truth(&square(), 2);
    let on = measured(&truth, &carpet(0.0));
    assert_eq!(on.weight_before_surface, 0.0);
    close(on.depth.spread, 0.0, 1e-6);
    // 5 % of the distance is the limit.
    assert_eq!(measured(&truth, &carpet(-0.04 * DISTANCE)).weight_before_surface, 0.0);
    // Rows that the cameras see beside the square, which is farther away, are before nothing.
    let before = measured(&truth, &carpet(-0.06 * DISTANCE)).weight_before_surface;
    assert!((0.8..=1.0).contains(&before), "{before}");
    // A veil, which is too large for a floater, takes half of the light one unit before the opaque rows.
    let mut model = carpet(0.0);
    for row in 0..model.len() {
        model.opacity_logits[row] = logit(0.99);
    }
    push(&mut model, DVec3::new(0.0, 0.0, -1.0), DVec3::new(50.0, 50.0, 0.01), 0.5);
    let veiled = measured(&truth, &model);
    assert_eq!(veiled.floaters.count, 0);
    close(veiled.depth.spread, 0.5 / DIAGONAL, 0.02);
    // The veil also has weight beside the square, which covers 4/9 of each view.
    close(veiled.weight_before_surface, 0.5 / (0.5 + 0.5 * 4.0 / 9.0), 0.05);
}

#[test]
fn a_tilt_of_normals_is_measured() {
    let mut model = carpet(0.0);
    let tilt = DQuat::from_rotation_x(20f64.to_radians());
    model.quats.fill([tilt.w, tilt.x, tilt.y, tilt.z].map(|v| v as f32));
    close(measured(&truth(&square(), 2), &model).normal_error, 20.0, 1e-4);
}

#[test]
fn only_floaters_are_counted() {
    let truth = truth(&square(), 2);
    let small = DVec3::splat(0.02);
    let floaters_with = |place: DVec3, scale: DVec3, opacity: f32| {
        let mut model = carpet(0.0);
        push(&mut model, place, scale, opacity);
        measured(&truth, &model).floaters
    };
    let floater = floaters_with(DVec3::new(0.0, 0.0, -1.0), small, 0.9);
    assert_eq!((floater.count, floater.of_rows), (1, 1.0 / 1601.0));
    // The nearly opaque floater covers 2π σ² at distance 2, which is 2π (0.02 · 32)² px in each of 2 views; the other
    // rows cover the square, 2 · (64 · 2 / 3)² px.
    assert!((5e-4..3e-3).contains(&floater.of_weight), "{}", floater.of_weight);
    let cases = [
        ("behind the square", DVec3::new(0.0, 0.0, 1.0), small, 0.9),
        ("faint", DVec3::new(0.0, 0.0, -1.0), small, 0.04),
        ("large", DVec3::new(0.0, 0.0, -1.0), DVec3::new(0.02, 0.6, 0.02), 0.9),
        ("near", DVec3::new(0.0, 0.0, -0.027), DVec3::splat(0.001), 0.9),
        ("seen by one view", DVec3::new(-1.0, 0.0, -1.2), small, 0.9),
        ("behind the cameras", DVec3::new(0.0, 0.0, -4.0), small, 0.9),
    ];
    for (case, place, scale, opacity) in cases {
        assert_eq!(floaters_with(place, scale, opacity).count, 0, "{case}");
    }
    // Beside the square the views see the background, so the space there is empty, too.
    assert_eq!(floaters_with(DVec3::new(0.0, 1.2, 0.0), small, 0.9).count, 1);
}

#[test]
fn blended_and_negligible_rows_are_counted() {
    let truth = truth(&square(), 2);
    let mut model = Gaussians::default();
    push(&mut model, DVec3::ZERO, DVec3::new(50.0, 50.0, 0.01), 0.9);
    let g = measured(&truth, &model).redundancy;
    assert_eq!((g.blended_per_pixel, g.below_one_percent), (1.0, 0.0));
    // The second row is behind the first: 0.08 · (1 − 0.9) is less than 0.01.
    push(&mut model, DVec3::Z, DVec3::new(50.0, 50.0, 0.01), 0.08);
    let g = measured(&truth, &model).redundancy;
    assert_eq!((g.blended_per_pixel, g.below_one_percent), (2.0, 0.5));
}

#[test]
fn thin_structures_are_found_or_missed() {
    // A bar of 0.1 x 0.1, its front at z = −1: 3.2 px wide at distance 2.
    let bar = (DVec3::new(-0.05, -0.9, -1.0), DVec3::new(0.05, 0.9, -0.9));
    let mut triangles = square();
    triangles.extend(cuboid(bar.0, bar.1));
    let truth = truth(&triangles, 2);
    let mut model = carpet(0.0);
    let missed = measured(&truth, &model).thin;
    assert_eq!(missed.len(), 1);
    assert_eq!((missed[0].width, missed[0].recall), (4.0, 0.0));
    // The front is 3.2 px x 57.6 px in both views, and a strip of the side is visible.
    assert!((300..=460).contains(&missed[0].pixels), "{}", missed[0].pixels);
    for i in 0..90 {
        let place = DVec3::new(0.0, -0.89 + 0.02 * f64::from(i), -1.0);
        push(&mut model, place, DVec3::new(0.08, 0.03, 0.001), 0.98);
    }
    let found = measured(&truth, &model).thin;
    assert_eq!(found[0].pixels, missed[0].pixels);
    assert!(found[0].recall > 0.95, "{found:?}");
    // Rows of another colour do not match the image.
    for value in &mut model.sh[3 * 1600..] {
        *value = rgb_to_dc(0.9);
    }
    assert_eq!(measured(&truth, &model).thin[0].recall, 0.0);
}

#[test]
fn measurements_without_data_are_nan() {
    let g = measured(&truth(&square(), 2), &Gaussians::default());
    assert_eq!((g.depth.coverage, g.floaters.count), (0.0, 0));
    assert!(g.depth.rmse.is_nan() && g.centres.accuracy.is_nan() && g.normal_error.is_nan());
    assert!(g.floaters.of_rows.is_nan());
    let text = serde_json::to_string(&g).unwrap();
    assert!(text.contains(r#""rmse":null"#), "{text}");
    let back: Geometry = serde_json::from_str(&text).unwrap();
    assert!(back.depth.rmse.is_nan() && back.depth.coverage == 0.0);
    // Files of older versions lack some measurements.
    let older =
        text.replace(r#""weight_before_surface":null,"#, "").replace(r#""spread":null,"#, "");
    assert!(!older.contains("spread") && !older.contains("before"), "{older}");
    let back: Geometry = serde_json::from_str(&older).unwrap();
    assert!(back.depth.spread.is_nan() && back.weight_before_surface.is_nan());
}

/// A mesh of triangles with vertices of their own.
fn mesh_of(triangles: &[[DVec3; 3]]) -> densify_scenegen::mesh::Model {
    densify_scenegen::mesh::Model {
        positions: triangles.as_flattened().to_vec(),
        triangles: (0..triangles.len() as u32).map(|t| [0, 1, 2].map(|c| 3 * t + c)).collect(),
        ..Default::default()
    }
}

#[test]
fn meshes_are_measured_in_both_directions() {
    // A second square behind the first, which no camera sees, needs no mesh.
    let mut triangles = square();
    triangles.extend(square().into_iter().map(|t| t.map(|p| p + DVec3::Z)));
    let truth = truth(&triangles, 4);
    let scene = KnownScene {
        truth: &truth,
        normalisation: &WORLD,
        background: [0.0; 3],
        sh_degree: 0,
        is_stopped: &|| false,
    };
    let measured = |triangles: &[[DVec3; 3]]| {
        measure_mesh(&mesh_of(triangles), &scene, &Pair::new().cameras).unwrap()
    };
    let diagonal = scene.diagonal();
    let exact = measured(&square());
    assert!(exact.chamfer < 1e-6 && exact.f_score_half_percent == 1.0, "{exact:?}");
    // Moved by 0.8 % of the diagonal.
    let offset = DVec3::new(0.0, 0.0, -0.008 * diagonal);
    let corners = |triangle: [DVec3; 3]| triangle.map(|corner| corner + offset);
    let moved = measured(&square().into_iter().map(corners).collect::<Vec<_>>());
    close(moved.accuracy, 0.008, 1e-6);
    close(moved.completeness, 0.008, 1e-6);
    assert_eq!((moved.f_score_half_percent, moved.f_score_one_percent), (0.0, 1.0));
    // One of the two triangles: half the surface is within the limit, and a strip beside the diagonal.
    let half = measured(&square()[..1]);
    assert!(half.accuracy < 1e-6 && half.precision_one_percent == 1.0);
    let strip = 0.01 * diagonal * 2.0 * 2f64.sqrt() / 4.0;
    close(half.recall_one_percent, 0.5 + strip, 0.01);
    let recall = half.recall_one_percent;
    close(half.f_score_one_percent, 2.0 * recall / (1.0 + recall), 1e-12);
    assert!(measure_mesh(&mesh_of(&[]), &scene, &Pair::new().cameras).is_err());
}
