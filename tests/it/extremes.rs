//! Where `f32` breaks first: needles, thousands of layers, saturated opacities, rows that hold
//! anything at all.

use densify::backend::Rendering;
use densify::backend::cpu::ModelGradient;
use densify::camera::Camera;
use densify::gaussians::Gaussians;

use crate::compare::{Limits, Table, compare_images, relative_error};
use crate::gradients::check;
use crate::reference::{CLASSES, Model, Rules, View, differentiate};
use crate::scenes;
use crate::subject::{self, Resources};

const GREY: [f32; 3] = [0.2, 0.5, 0.3];

/// A camera that looks along z, at the origin, so that sizes can be given in pixels.
fn straight(width: u32, height: u32) -> Camera {
    Camera {
        width,
        height,
        fx: 64.0,
        fy: 64.0,
        cx: 0.5 * f64::from(width),
        cy: 0.5 * f64::from(height),
        rotation: glam::DMat3::IDENTITY,
        translation: glam::DVec3::ZERO,
    }
}

fn flat_colour(k: usize) -> f32 {
    0.4 - 0.3 * k as f32
}

#[test]
fn needles_in_every_direction() {
    let camera = straight(48, 48);
    let mut table = Table::new("needles");
    // The gradient of the long axis is what remains when the short axis's share of dL/dΣ, larger
    // by the squared ratio of the widths, cancels; the usual route over the inverse of Σ
    // leaves nothing of it at 300 px already.
    for (sigma_px, tolerance) in [(10.0_f32, 1e-3), (100.0, 5e-3), (1000.0, 1e-1)] {
        for turn in 0..16 {
            let angle = std::f32::consts::PI * (turn as f32 + 0.3) / 16.0;
            let mut model = Gaussians::default();
            // At z = 1 a pixel is 1/64 wide; the needle is 0.01 px thin before the blur.
            let scale = [sigma_px / 64.0, 0.01 / 64.0, 0.01 / 64.0];
            let quat = [(0.5 * angle).cos(), 0.0, 0.0, (0.5 * angle).sin()];
            scenes::push(&mut model, [0.01, -0.02, 1.0], scale, quat, 2.0, flat_colour);
            let what = format!("{sigma_px} px, turn {turn}");
            check_needle(&mut table, &what, &model, &camera, tolerance);
        }
    }
    table.finish();
}

fn check_needle(table: &mut Table, what: &str, model: &Gaussians, camera: &Camera, tolerance: f64) {
    let view = View { camera, background: GREY.map(f64::from), sh_degree: 0 };
    let upstream = scenes::upstream(camera, 4);
    let (image, gradient) = differentiate(&Model::of(model), view, &Rules::STANDARD, &upstream);
    let mut backend = subject::backend(model, Resources::default());
    let (found, measured) = subject::differentiate(&mut backend, camera, GREY, 0, &upstream);
    let limits = Limits { interior: 1e-3, step: 1.5 / 255.0, ..Limits::CPU };
    let outcome = compare_images(&found.alpha, &image.alpha, &image.boundary, limits);
    table.image(what, "alpha", outcome, limits);
    for class in CLASSES {
        let error = relative_error(subject::class(&measured, class), gradient.model.class(class));
        table.check(what, class, error, tolerance);
    }
}

#[test]
fn thousands_of_faint_layers() {
    let camera = straight(5, 4);
    let mut table = Table::new("layers");
    for (rows, logit) in [(2400_usize, -5.5_f32), (600, -3.0), (20_000, -5.0)] {
        let mut model = Gaussians::default();
        for row in 0..rows {
            let z = 1.0 + row as f32 / rows as f32;
            let shade = |k: usize| ((row * 7 + k * 5) % 11) as f32 * 0.1 - 0.5;
            scenes::push(
                &mut model,
                [0.0, 0.0, z],
                [0.3 * z; 3],
                [1.0, 0.0, 0.0, 0.0],
                logit,
                shade,
            );
        }
        check(&mut table, &format!("{rows} layers"), &model, &camera, GREY, 0);
    }
    table.finish();
}

#[test]
fn opacities_to_both_ends() {
    let camera = scenes::camera(40, 30, 17);
    let mut table = Table::new("opacities");
    let logits =
        [-104.0, -88.0, -50.0, -9.2, -5.6, -5.5, 0.0, 4.4, 4.7, 9.2, 16.6, 17.0, 40.0, 90.0];
    for (seed, &logit) in logits.iter().enumerate() {
        let mut model = scenes::cloud(12, 0, &camera, 30 + seed as u64);
        for (row, opacity) in model.opacity_logits.iter_mut().enumerate() {
            if row % 2 == 0 {
                *opacity = logit;
            }
        }
        check(&mut table, &format!("logit {logit}"), &model, &camera, GREY, 0);
    }
    table.finish();
}

#[test]
fn quaternions_of_any_length() {
    let camera = scenes::camera(40, 30, 18);
    let mut table = Table::new("quaternions");
    for length in [1e-5_f32, 1e-2, 1.0, 1e3, 1e6] {
        let mut model = scenes::cloud(12, 0, &camera, 31);
        for quat in &mut model.quats {
            *quat = quat.map(|v| v * length);
        }
        check(&mut table, &format!("length {length:e}"), &model, &camera, GREY, 0);
    }
    table.finish();
}

/// What `values` is without row `row`, given `per_row` values each.
fn without<T: Clone>(values: &[T], row: usize, per_row: usize) -> Vec<T> {
    [&values[..row * per_row], &values[(row + 1) * per_row..]].concat()
}

pub(crate) fn remove(model: &Gaussians, row: usize) -> Gaussians {
    let per_row = model.sh.len() / model.len();
    Gaussians {
        sh_degree: model.sh_degree,
        means: without(&model.means, row, 1),
        log_scales: without(&model.log_scales, row, 1),
        quats: without(&model.quats, row, 1),
        opacity_logits: without(&model.opacity_logits, row, 1),
        sh: without(&model.sh, row, per_row),
    }
}

fn run(model: &Gaussians, camera: &Camera) -> (Rendering, ModelGradient) {
    let mut backend = subject::backend(model, Resources::default());
    let upstream = scenes::upstream(camera, 5);
    subject::differentiate(&mut backend, camera, GREY, model.sh_degree, &upstream)
}

fn bits(values: &[f32]) -> Vec<u32> {
    values.iter().map(|v| v.to_bits()).collect()
}

#[test]
fn a_poisoned_row_harms_no_other() {
    let camera = scenes::camera(33, 30, 19);
    let model = scenes::cloud(24, 3, &camera, 32);
    let poisoned = 11;
    let (clean_image, clean) = run(&remove(&model, poisoned), &camera);
    let mut harmed = Vec::new();
    for value in [f32::NAN, -f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        for slot in 0..59 {
            let mut model = model.clone();
            *slot_of(&mut model, poisoned, slot) = value;
            let (image, gradient) = run(&model, &camera);
            // Infinitely faint, and infinitely opaque, are opacities like others.
            if slot == 10 && value == f32::INFINITY {
                if image.rgb.iter().any(|v| !v.is_finite()) {
                    harmed.push(format!("{value} in {}: not finite", place(slot)));
                }
                continue;
            }
            let same_image = bits(&image.rgb) == bits(&clean_image.rgb);
            let same_gradient = CLASSES.iter().all(|class| {
                let all = subject::class(&gradient, class);
                let others = without(all, poisoned, all.len() / model.len());
                bits(&others) == bits(subject::class(&clean, class))
            });
            if !same_image || !same_gradient {
                harmed.push(format!(
                    "{value} in {}: image {}, gradients {}",
                    place(slot),
                    if same_image { "same" } else { "changed" },
                    if same_gradient { "same" } else { "changed" },
                ));
            }
        }
    }
    let cases = harmed.len();
    harmed.dedup();
    assert!(
        harmed.is_empty(),
        "{cases} cases:
{}",
        harmed.join(
            "
"
        )
    );
}

/// What slot `slot` belongs to.
fn place(slot: usize) -> &'static str {
    match slot {
        0..3 => "a mean",
        3..6 => "a log-scale",
        6..10 => "a quaternion",
        10 => "an opacity logit",
        11..14 => "band 0 of the colour",
        _ => "bands 1 to 3 of the colour",
    }
}

/// The 59 numbers of a row: mean, log-scale, quaternion, opacity, coefficients.
pub(crate) fn slot_of(model: &mut Gaussians, row: usize, slot: usize) -> &mut f32 {
    match slot {
        0..3 => &mut model.means[row][slot],
        3..6 => &mut model.log_scales[row][slot - 3],
        6..10 => &mut model.quats[row][slot - 6],
        10 => &mut model.opacity_logits[row],
        _ => &mut model.sh[row * 48 + slot - 11],
    }
}

#[test]
fn any_finite_number_gives_a_finite_image() {
    let camera = scenes::camera(33, 30, 20);
    let model = scenes::cloud(24, 3, &camera, 33);
    let values =
        [0.0, -0.0, 1e-45, -1e-45, 1e-38, 1e-20, 1e4, -1e4, 1e19, -1e19, f32::MAX, f32::MIN];
    let mut broken = Vec::new();
    for value in values {
        for slot in 0..59 {
            let mut model = model.clone();
            *slot_of(&mut model, 11, slot) = value;
            let (image, gradient) = run(&model, &camera);
            let image_finite = image.rgb.iter().chain(&image.depth).all(|v| v.is_finite());
            let gradient_finite = CLASSES.iter().all(|class| {
                let all = subject::class(&gradient, class);
                without(all, 11, all.len() / model.len()).iter().all(|v| v.is_finite())
            });
            if !image_finite || !gradient_finite {
                broken.push(format!(
                    "{value:e} in {}: image {}, gradients of others {}",
                    place(slot),
                    if image_finite { "finite" } else { "broken" },
                    if gradient_finite { "finite" } else { "broken" },
                ));
            }
        }
    }
    let cases = broken.len();
    broken.dedup();
    assert!(
        broken.is_empty(),
        "{cases} cases:
{}",
        broken.join(
            "
"
        )
    );
}

#[test]
fn a_camera_at_a_row_s_mean_or_inside_it_is_harmless() {
    let camera = scenes::camera(33, 30, 21);
    let mut model = scenes::cloud(10, 2, &camera, 34);
    for (row, z) in [0.0, 0.02, 0.1, 1.0].into_iter().enumerate() {
        model.means[row] = scenes::world(&camera, [0.0, 0.0, z]);
        model.log_scales[row] = [0.7, 0.0, 2.0];
    }
    let (image, gradient) = run(&model, &camera);
    assert!(image.rgb.iter().all(|v| v.is_finite()));
    for class in CLASSES {
        assert!(subject::class(&gradient, class).iter().all(|v| v.is_finite()), "{class}");
    }
}
