//! Properties of arbitrary scenes, cameras and image sizes.

use densify::core::camera::Camera;
use densify::core::gaussians::{Gaussians, sh_coefficients};
use densify::render::Rendering;
use densify::selftest::reference::CLASSES;
use densify::selftest::values::SIZES;
use densify::selftest::{Setup, Subject, scenes};
use proptest::prelude::*;
use proptest::test_runner::{TestCaseResult, TestRunner};

use crate::subject::{BLUE, bits, cases_on, class, make_with, on_each, repeatable};

/// A Gaussian: position in camera space as image fractions and depth, log-scales, quaternion, opacity logit and the
/// seed of its colours.
type Row = ([f64; 3], [f32; 3], [f32; 4], f32, f32);

fn row() -> impl Strategy<Value = Row> {
    (
        [-0.5..1.5_f64, -0.5..1.5_f64, -2.0..20.0_f64],
        // From much smaller than a pixel to much larger than the image.
        prop::array::uniform3(-12.0..3.0_f32),
        prop::array::uniform4(-1e3..1e3_f32),
        -12.0..12.0_f32,
        -3.0..3.0_f32,
    )
}

fn view() -> impl Strategy<Value = Camera> {
    // The selftest covers very long images.
    (0..SIZES.len() - 1, any::<u64>())
        .prop_map(|(size, seed)| scenes::camera(SIZES[size].0, SIZES[size].1, seed))
}

fn model(camera: &Camera, sh_degree: u8, rows: &[Row]) -> Gaussians {
    let mut model = Gaussians { sh_degree, ..Gaussians::default() };
    for (i, ([u, v, z], scale, quat, logit, shade)) in rows.iter().enumerate() {
        // Depths are distinct, because the row order breaks ties.
        let z = z + 1e-3 * i as f64;
        let x = (u * f64::from(camera.width) - camera.cx) / camera.fx * z;
        let y = (v * f64::from(camera.height) - camera.cy) / camera.fy * z;
        let mean = scenes::world(camera, [x, y, z]);
        let colour = |k: usize| shade * (1.7 * k as f32 + i as f32).sin();
        scenes::push(&mut model, mean, scale.map(f32::exp), *quat, *logit, colour);
    }
    model
}

fn render(
    subject: &Subject,
    model: &Gaussians,
    camera: &Camera,
    background: [f32; 3],
    tile_cap: Option<usize>,
) -> Rendering {
    let mut backend = make_with(subject, model, Setup { tile_cap, ..Setup::default() });
    backend.render(camera, background, model.sh_degree).expect("a small image is rendered")
}

/// The sorted depths. Rows of equal depth are blended in row order.
fn depths(model: &Gaussians, camera: &Camera) -> Vec<f64> {
    let depth = |mean: &[f32; 3]| camera.project(mean.map(f64::from).into()).1;
    let mut depths: Vec<f64> = model.means.iter().map(depth).collect();
    depths.sort_by(f64::total_cmp);
    depths
}

/// The deterministic backends without SwiftShader, which takes seconds per case.
fn fast() -> Vec<Subject> {
    let is_slow = |subject: &Subject| subject.name().contains("SwiftShader");
    repeatable().into_iter().filter(|subject| !is_slow(subject)).collect()
}

/// Checks a property on every backend with random inputs.
fn for_any<S: Strategy>(inputs: &S, check: impl Fn(&Subject, S::Value) -> TestCaseResult) {
    on_each(fast(), |subject| {
        let mut runner = TestRunner::new(cases_on(subject, 24));
        let outcome = runner.run(inputs, |input| check(subject, input));
        outcome.unwrap_or_else(|error| panic!("{}: {error}", subject.name()));
    });
}

#[test]
fn rendering_is_finite_and_independent_of_row_order_and_bands() {
    let rows = prop::collection::vec(row(), 0..60);
    let inputs = (view(), 0..=3_u8, rows, 0..60_usize, 1..400_usize);
    for_any(&inputs, |subject, (camera, degree, rows, shift, cap)| {
        let whole = model(&camera, degree, &rows);
        let depths = depths(&whole, &camera);
        let mut reordered = whole.clone();
        let shift = shift % whole.len().max(1);
        reordered.means.rotate_left(shift);
        reordered.log_scales.rotate_left(shift);
        reordered.quats.rotate_left(shift);
        reordered.opacity_logits.rotate_left(shift);
        reordered.sh.rotate_left(shift * 3 * sh_coefficients(degree));
        let render = |model: &Gaussians, cap| render(subject, model, &camera, BLUE, cap);
        let image = render(&whole, None);
        prop_assert!(image.rgb.iter().chain(&image.depth).all(|v| v.is_finite()));
        let upstream = scenes::narrowed(&scenes::upstream(&camera, 4));
        let mut backend = make_with(subject, &whole, Setup::default());
        let outcome = backend.differentiate(&camera, BLUE, degree, &upstream);
        let (_, gradient) = outcome.expect("a small image is rendered");
        for name in CLASSES {
            prop_assert!(class(&gradient, name).iter().all(|g| g.is_finite()), "{}", name);
        }
        prop_assert!(image.alpha.iter().all(|a| (0.0..=1.0).contains(a)));
        prop_assert!(bits(&render(&whole, Some(cap))) == bits(&image), "bands");
        if depths.windows(2).all(|pair| pair[1] - pair[0] > 1e-5 * pair[1].abs()) {
            prop_assert!(bits(&render(&reordered, None)) == bits(&image), "order");
        }
        Ok(())
    });
}

#[test]
fn hidden_rows_change_nothing_and_the_background_is_linear() {
    let rows = prop::collection::vec(row(), 0..40);
    let inputs = (view(), rows, prop::array::uniform3(0.0..1.0_f32), 0..3_usize);
    for_any(&inputs, |subject, (camera, rows, background, place)| {
        let seen = model(&camera, 1, &rows);
        let mut more = seen.clone();
        let (local, logit) =
            [([0.0, 0.0, -1.0], 1.0), ([500.0, 0.0, 2.0], 1.0), ([0.0, 0.0, 2.0], -6.0)][place];
        let mean = scenes::world(&camera, local);
        scenes::push(&mut more, mean, [0.1; 3], [1.0, 0.0, 0.0, 0.0], logit, |_| 0.3);
        let render = |model: &Gaussians, on| render(subject, model, &camera, on, None);
        let on_black = render(&seen, [0.0; 3]);
        prop_assert!(bits(&render(&more, [0.0; 3])) == bits(&on_black));
        let on_colour = render(&seen, background);
        for (p, alpha) in on_black.alpha.iter().enumerate() {
            for (c, background) in background.iter().enumerate() {
                let black = on_black.rgb[3 * p + c];
                let expected = black + (1.0 - alpha) * background;
                let error = (on_colour.rgb[3 * p + c] - expected).abs();
                prop_assert!(error <= 1e-6 * (1.0 + black.abs()), "pixel {p}: {error:e}");
            }
        }
        Ok(())
    });
}
