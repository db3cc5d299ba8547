//! Checks the reference gradients against central differences in `f64`, without the thresholds that make a
//! rendering discontinuous and with the depth order held fixed.

use densify::core::antialiasing::Antialiasing;
use densify::core::camera::Camera;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use densify::selftest::compare::Table;
use densify::selftest::reference::loss::loss;
use densify::selftest::reference::project::{by_depth, project};
use densify::selftest::reference::{
    CLASSES, Model, Rules, Upstream, View, blend, differentiate, render,
};
use densify::selftest::scenes;
use densify_policies::policy::PixelLoss;

/// Step of the central difference, to either side.
const STEP: f64 = 1e-6;
/// Tolerance relative to the largest gradient of the class. The rounding error is eps·|L| / STEP ≈ 1e-16·10 / 1e-6 and
/// the truncation error STEP²; for losses and gradients around 1, both errors are smaller than the tolerance.
const TOLERANCE: f64 = 1e-6;

/// Compares every gradient of Σ image · upstream with its central difference; reports the worst per class.
fn check(table: &mut Table, case: &str, model: &Model, view: View<'_>, upstream: &Upstream) {
    let order = by_depth(&project(model, view, &Rules::SMOOTH));
    let value = |model: &Model| {
        let splats = project(model, view, &Rules::SMOOTH);
        blend::render(&splats, &order, view, &Rules::SMOOTH).dot(upstream)
    };
    let (_, analytic) = differentiate(model, view, &Rules::SMOOTH, upstream);
    for class in CLASSES {
        let expected = analytic.model.class(class);
        let largest = expected.iter().fold(0.0_f64, |m, g| m.max(g.abs()));
        let mut moved = model.clone();
        let mut worst = 0.0_f64;
        for (i, analytic) in expected.iter().enumerate() {
            let at = model.class(class)[i];
            moved.class_mut(class)[i] = at + STEP;
            let above = value(&moved);
            moved.class_mut(class)[i] = at - STEP;
            let below = value(&moved);
            moved.class_mut(class)[i] = at;
            let difference = ((above - below) / (2.0 * STEP) - analytic).abs();
            worst = if difference.is_nan() { f64::NAN } else { worst.max(difference) };
        }
        table.check(case, class, worst / largest.max(1e-3), TOLERANCE);
    }
}

fn view(camera: &Camera, sh_degree: u8) -> View<'_> {
    View { camera, background: [0.2, 0.9, 0.5], sh_degree }
}

#[test]
fn gradients_of_every_class_match_at_every_degree() {
    let mut table = Table::new("reference against central differences");
    for degree in 0..=3 {
        let camera = scenes::camera(13, 11, 40 + u64::from(degree));
        let model = Model::from(&scenes::cloud(7, degree, &camera, 70 + u64::from(degree)));
        let upstream = scenes::upstream(&camera, 3);
        check(&mut table, &format!("degree {degree}"), &model, view(&camera, degree), &upstream);
        if degree > 0 {
            // Stored harmonics above the evaluated degree get no gradient.
            let case = format!("degree {} of {degree}", degree - 1);
            check(&mut table, &case, &model, view(&camera, degree - 1), &upstream);
        }
    }
    table.finish();
}

#[test]
fn gradients_match_with_antialiasing() {
    let mut table = Table::new("reference with antialiasing");
    for kind in [Antialiasing::Wide, Antialiasing::Narrow] {
        for size in [1.0_f32, 0.2] {
            let camera = scenes::camera(13, 11, 44);
            let mut cloud = scenes::cloud(7, 1, &camera, 72);
            cloud.antialiasing = kind;
            cloud.log_scales.as_flattened_mut().iter_mut().for_each(|log| *log += size.ln());
            let upstream = scenes::upstream(&camera, 3);
            let case = format!("{kind}, {size} times");
            check(&mut table, &case, &Model::from(&cloud), view(&camera, 1), &upstream);
        }
    }
    table.finish();
}

#[test]
fn gradients_match_where_the_jacobian_is_clamped() {
    // Large Gaussians whose centres are far outside the image: the slope is clamped in x, in y, or in both.
    let camera = Camera { cx: 2.0, cy: 9.5, fx: 9.0, fy: 14.0, ..scenes::camera(12, 10, 5) };
    let mut table = Table::new("reference beyond the frustum");
    for (case, local) in
        [("x", [4.0, 0.2, 2.0]), ("y", [0.1, -3.5, 2.2]), ("both", [-2.6, 2.0, 2.1])]
    {
        let model = Model::from(&scenes::one_at(&camera, local, [1.1, 0.9, 1.3]));
        let seen = render(&model, view(&camera, 1), &Rules::SMOOTH);
        assert!(
            seen.alpha.iter().any(|&alpha| alpha > 0.01),
            "{case}: the Gaussian is not visible"
        );
        check(&mut table, case, &model, view(&camera, 1), &scenes::upstream(&camera, 9));
    }
    table.finish();
}

#[test]
fn the_gradient_of_the_loss_matches() {
    let mut table = Table::new("reference loss against central differences");
    let mut rng = ChaCha8Rng::seed_from_u64(8);
    let sizes = [(1, 1), (1, 17), (17, 1), (7, 5), (14, 12)];
    let all = |size| [PixelLoss::L1, PixelLoss::Huber].map(|pixel_loss| (size, pixel_loss));
    for ((width, height), pixel_loss) in sizes.into_iter().flat_map(all) {
        let n = 3 * width * height;
        let target: Vec<f64> = (0..n).map(|_| rng.random::<f64>()).collect();
        // L1 has no derivative at equality.
        let rendered: Vec<f64> = target
            .iter()
            .map(|t| t + rng.random_range(0.01..0.3) * if rng.random() { 1.0 } else { -1.0 })
            .collect();
        let analytic = loss(&rendered, &target, (width, height), pixel_loss);
        let largest = analytic.gradient.iter().fold(0.0_f64, |m, g| m.max(g.abs()));
        let mut moved = rendered.clone();
        let mut worst = 0.0_f64;
        for i in 0..n {
            moved[i] = rendered[i] + STEP;
            let above = loss(&moved, &target, (width, height), pixel_loss).minimised;
            moved[i] = rendered[i] - STEP;
            let below = loss(&moved, &target, (width, height), pixel_loss).minimised;
            moved[i] = rendered[i];
            let difference = (above - below) / (2.0 * STEP) - analytic.gradient[i];
            worst = worst.max(difference.abs());
        }
        table.check(
            &format!("{width}x{height}, {pixel_loss:?}"),
            "rendered",
            worst / largest,
            TOLERANCE,
        );
    }
    table.finish();
}
