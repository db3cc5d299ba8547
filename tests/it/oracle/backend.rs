//! The backend against the stored arrays: images to 2e-5 where no decision is close, gradients
//! and statistics to ten times what float32 arithmetic loses.

use densify::backend::Rendering;
use densify::backend::cpu::ModelGradient;

use super::case::{Case, Part, cases};
use crate::subject::{self, Resources};
use densify::verify::compare::{Limits, Table, compare_images, relative_error};
use densify::verify::reference::blend::leeway;
use densify::verify::reference::project::{by_depth, project};
use densify::verify::reference::{CLASSES, Model, Rules, View};

#[test]
fn the_backend_reproduces_images() {
    let mut table = Table::new("images against stored ones");
    for case in &cases() {
        let mut backend = subject::backend(&case.model, Resources::default());
        for camera in 0..case.cameras.len() {
            let upstream = case.upstream(camera, Part::Full);
            let (image, _) = subject::differentiate(
                &mut backend,
                &case.cameras[camera],
                case.background,
                case.sh_degree,
                &upstream,
            );
            check_image(&mut table, case, camera, &image);
        }
    }
    table.finish();
}

fn check_image(table: &mut Table, case: &Case, camera: usize, image: &Rendering) {
    let close: Vec<bool> = case.decided(camera).iter().map(|ok| !ok).collect();
    let depth = case.of_camera("depth_acc", camera);
    let scale = depth.iter().fold(1.0_f64, |m, d| m.max(*d));
    // A flipped row changes depth by its share of the depth; elsewhere all three are held to
    // the same absolute difference.
    let deep = Limits { step: Limits::CPU.step * scale, ..Limits::CPU };
    let arrays = [
        ("rgb", &image.rgb, Limits::CPU),
        ("alpha", &image.alpha, Limits::CPU),
        ("depth_acc", &image.depth, deep),
    ];
    for (key, measured, limits) in arrays {
        let expected = case.of_camera(key, camera);
        table.image(&case.name, key, compare_images(measured, expected, &close, limits), limits);
    }
}

#[test]
fn the_backend_reproduces_gradients() {
    let mut table = Table::new("gradients against stored ones");
    for case in &cases() {
        for part in Part::ALL {
            check_gradients(&mut table, case, part);
        }
    }
    table.finish();
}

/// Stored gradients of parameters are sums over cameras, those on the screen are per camera.
fn check_gradients(table: &mut Table, case: &Case, part: Part) {
    let mut backend = subject::backend(&case.model, Resources::default());
    let mut sums: Vec<Vec<f64>> = Vec::new();
    let prefix = format!("grad_{}", part.key());
    let mut check = |key: &str, measured: &[f64], expected: &[f64]| {
        table.check(&case.name, key, relative_error(measured, expected), case.tolerance(key));
    };
    for camera in 0..case.cameras.len() {
        let (_, gradient) = subject::differentiate(
            &mut backend,
            &case.cameras[camera],
            case.background,
            case.sh_degree,
            &case.upstream(camera, part),
        );
        let classes: Vec<Vec<f64>> = CLASSES.map(|c| widened(subject::class(&gradient, c))).into();
        if sums.is_empty() {
            sums = classes;
        } else {
            for (sum, class) in sums.iter_mut().zip(classes) {
                sum.iter_mut().zip(class).for_each(|(s, g)| *s += g);
            }
        }
        let mut on_screen = |name: &str, measured: &[f32]| {
            let key = format!("{prefix}.{name}");
            check(&key, &widened(measured), case.of_camera(&key, camera));
        };
        if matches!(part, Part::Colour | Part::Full) {
            on_screen("mean2d", gradient.mean2d.as_flattened());
            on_screen("mean2d_abs", gradient.mean2d_abs.as_flattened());
        }
        if part == Part::Colour {
            on_screen("g_color", gradient.colour.as_flattened());
        }
    }
    for (class, sum) in CLASSES.iter().zip(sums) {
        let key = format!("{prefix}.{class}");
        check(&key, &sum, case.expected(&key));
    }
}

fn widened(values: &[f32]) -> Vec<f64> {
    values.iter().copied().map(f64::from).collect()
}

#[test]
fn the_backend_reproduces_statistics() {
    let mut table = Table::new("statistics against stored ones");
    for case in &cases() {
        let mut backend = subject::backend(&case.model, Resources::default());
        for camera in 0..case.cameras.len() {
            let (_, gradient) = subject::differentiate(
                &mut backend,
                &case.cameras[camera],
                case.background,
                case.sh_degree,
                &case.upstream(camera, Part::Full),
            );
            check_statistics(&mut table, case, camera, &gradient);
        }
    }
    table.finish();
}

/// Stored statistics leave out pixels with a close decision; the backend's cannot. So each lies
/// between the stored value and that value plus what those pixels could add.
fn check_statistics(table: &mut Table, case: &Case, camera: usize, found: &ModelGradient) {
    let view = View {
        camera: &case.cameras[camera],
        background: case.background.map(f64::from),
        sh_degree: case.sh_degree,
    };
    let splats = project(&Model::of(&case.model), view, &Rules::STANDARD);
    let spare = leeway(&splats, &by_depth(&splats), view, &case.decided(camera));
    let stored = |key: &str| case.of_camera(key, camera);
    let beyond = |value: f64, from: f64, to: f64| (from - value).max(value - to).max(0.0);
    for (row, &(max, sum, pixels)) in spare.iter().enumerate() {
        let (value, least) = (f64::from(found.max_weight[row]), stored("max_weight")[row]);
        let off = beyond(value, least, least.max(max));
        table.check(&case.name, "max_weight", off, case.tolerance("max_weight"));

        let (value, least) = (f64::from(found.sum_weight[row]), stored("sum_weight")[row]);
        let off = beyond(value, least, least + sum) / least.max(1.0);
        table.check(&case.name, "sum_weight", off, case.tolerance("max_weight"));

        let (value, least) = (f64::from(found.pixel_count[row]), stored("n_pixels")[row]);
        let off = beyond(value, least, least + f64::from(pixels));
        table.check(&case.name, "n_pixels", off, 0.0);

        if found.visible[row] != (stored("visible")[row] > 0.0) {
            let name = &case.name;
            table.fail(format!("{name}: row {row} in view {camera}: visible is wrong"));
        }
    }
}
