//! The reference renderer against the stored arrays: both are float64, so they agree to 1e-9.

use super::case::{Case, Part, cases};
use densify::verify::compare::{Table, relative_error};
use densify::verify::reference::project::{by_depth, project};
use densify::verify::reference::{CLASSES, Gradient, Model, Rules, View, differentiate, render};

/// Two float64 computations in different order, needles of 1000:1 among them.
const TOLERANCE: f64 = 1e-9;

#[test]
fn the_reference_reproduces_every_stored_array() {
    let mut table = Table::new("reference against stored arrays");
    for case in &cases() {
        let model = Model::of(&case.model);
        for camera in 0..case.cameras.len() {
            check_projection(&mut table, case, &model, camera);
            check_image(&mut table, case, &model, camera);
        }
        for part in Part::ALL {
            check_gradients(&mut table, case, &model, part);
        }
    }
    table.finish();
}

fn view(case: &Case, camera: usize) -> View<'_> {
    View {
        camera: &case.cameras[camera],
        background: case.background.map(f64::from),
        sh_degree: case.sh_degree,
    }
}

fn check(table: &mut Table, case: &Case, key: &str, measured: &[f64], expected: &[f64]) {
    table.check(&case.name, key, relative_error(measured, expected), TOLERANCE);
}

fn check_projection(table: &mut Table, case: &Case, model: &Model, camera: usize) {
    let splats = project(model, view(case, camera), &Rules::STANDARD);
    let in_front: Vec<f64> = splats.iter().map(|s| f64::from(u8::from(s.in_front))).collect();
    let expected = case.of_camera("g_near_ok", camera);
    check(table, case, "g_near_ok", &in_front, expected);
    let mut quantity = |key: &str, values: Vec<Vec<f64>>| {
        let stored = case.of_camera(key, camera);
        let n = values.first().map_or(1, Vec::len);
        // Behind the camera everything stored is meaningless.
        let rows = || (0..values.len()).filter(|&row| splats[row].in_front);
        let measured: Vec<f64> = rows().flat_map(|row| values[row].clone()).collect();
        let expected: Vec<f64> =
            rows().flat_map(|row| stored[row * n..(row + 1) * n].to_vec()).collect();
        check(table, case, key, &measured, &expected);
    };
    quantity("g_mean2d", splats.iter().map(|s| s.mean.to_vec()).collect());
    quantity("g_cov2d", splats.iter().map(|s| s.covariance.to_vec()).collect());
    quantity("g_conic", splats.iter().map(|s| s.conic.to_vec()).collect());
    quantity("g_depth", splats.iter().map(|s| vec![s.depth]).collect());
    let clamped = |s: &[f64; 3]| s.map(|c| c.max(0.0)).to_vec();
    quantity("g_color", splats.iter().map(|s| clamped(&s.colour)).collect());
}

fn check_image(table: &mut Table, case: &Case, model: &Model, camera: usize) {
    let image = render(model, view(case, camera), &Rules::STANDARD);
    let decided = case.decided(camera);
    let mut compare = |key: &str, channels: usize, measured: &[f64]| {
        let expected = case.of_camera(key, camera);
        let keep = |values: &[f64]| -> Vec<f64> {
            let pixels = values.chunks_exact(channels).zip(&decided);
            pixels.filter(|(_, ok)| **ok).flat_map(|(v, _)| v.to_vec()).collect()
        };
        check(table, case, key, &keep(measured), &keep(expected));
    };
    compare("rgb", 3, &image.rgb);
    compare("alpha", 1, &image.alpha);
    compare("depth_acc", 1, &image.depth);
    compare("final_T", 1, &image.transmittance);
    let blended: Vec<f64> = image.blended.iter().copied().map(f64::from).collect();
    compare("n_contrib", 1, &blended);
    let pairs = image.depth.iter().zip(&image.alpha);
    let expected_depth: Vec<f64> = pairs.map(|(d, a)| d / a.max(1e-10)).collect();
    compare("depth_exp", 1, &expected_depth);

    // The reference calls a pixel close more rarely than the stored mask, which is wider.
    for (p, (&close, &ok)) in image.boundary.iter().zip(&decided).enumerate() {
        if close && ok {
            table.fail(format!("{}: pixel {p} of view {camera} is decided", case.name));
        }
    }
}

fn check_gradients(table: &mut Table, case: &Case, model: &Model, part: Part) {
    let mut sum = Model::zeros(model.rows(), model.coefficients);
    let mut loss = 0.0;
    let prefix = format!("grad_{}", part.key());
    for camera in 0..case.cameras.len() {
        let upstream = case.upstream(camera, part);
        let (image, gradient) =
            differentiate(model, view(case, camera), &Rules::STANDARD, &upstream);
        sum.add(&gradient.model);
        loss += image.dot(&upstream);
        check_screen(table, case, camera, &prefix, &gradient);
        if part == Part::Colour {
            check_statistics(table, case, model, camera, &gradient);
        }
    }
    for class in CLASSES {
        let key = format!("{prefix}.{class}");
        check(table, case, &key, sum.class(class), case.expected(&key));
    }
    let key = format!("loss_{}", part.key());
    check(table, case, &key, &[loss], case.expected(&key));
}

fn check_screen(table: &mut Table, case: &Case, camera: usize, prefix: &str, found: &Gradient) {
    let rows = &found.screen;
    let mut quantity = |name: &str, values: Vec<f64>| {
        let key = format!("{prefix}.{name}");
        check(table, case, &key, &values, case.of_camera(&key, camera));
    };
    if matches!(prefix, "grad_color" | "grad_full") {
        quantity("mean2d", rows.iter().flat_map(|s| s.mean).collect());
        quantity("mean2d_abs", rows.iter().flat_map(|s| s.mean_abs).collect());
    }
    if prefix == "grad_color" {
        quantity("g_conic", rows.iter().flat_map(|s| s.conic).collect());
        quantity("g_color", rows.iter().flat_map(|s| s.colour).collect());
        quantity("g_opac", rows.iter().map(|s| s.opacity).collect());
    }
}

/// Stored statistics leave undecided pixels out, the reference's do not.
fn check_statistics(
    table: &mut Table,
    case: &Case,
    model: &Model,
    camera: usize,
    gradient: &Gradient,
) {
    let rows = &gradient.screen;
    let all: Vec<f64> = rows.iter().map(|s| s.max_weight).collect();
    check(table, case, "max_weight_all", &all, case.of_camera("max_weight_all", camera));
    let splats = project(model, view(case, camera), &Rules::STANDARD);
    let decided = case.decided(camera);
    let leeway = densify::verify::reference::blend::leeway(
        &splats,
        &by_depth(&splats),
        view(case, camera),
        &decided,
    );
    let between = |value: f64, from: f64, to: f64| {
        (from - value).max(value - to).max(0.0) / to.max(f64::MIN_POSITIVE)
    };
    for (row, (found, (_, sum, pixels))) in rows.iter().zip(leeway).enumerate() {
        let least = case.of_camera("sum_weight", camera)[row];
        let off = between(found.sum_weight, least, least + sum);
        table.check(&case.name, "sum_weight", off, TOLERANCE);
        let least = case.of_camera("n_pixels", camera)[row];
        let off = between(f64::from(found.pixels), least, least + f64::from(pixels));
        table.check(&case.name, "n_pixels", off, TOLERANCE);
    }
}
