//! Every backend against the stored arrays: images to 2e-5 (1e-4 on a GPU) where no decision is close,
//! gradients and statistics to ten (twenty) times what float32 arithmetic loses.

use densify::backend::Rendering;
use densify::backend::cpu::ModelGradient;

use super::case::{Case, Part, cases};
use crate::subject::{all, class, make, wide};
use densify::backend::cpu::InstructionSet;
use densify::verify::compare::{Limits, Table, compare_images, relative_error};
use densify::verify::reference::blend::leeway;
use densify::verify::reference::project::{by_depth, project};
use densify::verify::reference::{CLASSES, Model, Rules, View};
use densify::verify::{Differentiable, Subject, scenes};

/// How many times what float32 arithmetic loses a backend may lose, in tens. Twice as much where a
/// product may be rounded before it is added: without fused multiply-add.
fn tens(subject: &Subject) -> f64 {
    match subject {
        Subject::Gpu(_) | Subject::Native { instructions: InstructionSet::Scalar, .. } => 2.0,
        Subject::Native { .. } => 1.0,
    }
}

/// One table for each backend, filled by `check` with every case and part of its loss.
fn on_every_backend(what: &str, check: impl Fn(&mut Table, &Subject, &Case)) {
    let cases = cases();
    for subject in all() {
        let mut table = Table::new(&format!("{what} of {} against stored ones", subject.name()));
        for case in &cases {
            check(&mut table, &subject, case);
        }
        table.finish();
    }
}

fn differentiate(
    backend: &mut dyn Differentiable,
    case: &Case,
    camera: usize,
    part: Part,
) -> (Rendering, ModelGradient) {
    let upstream = scenes::narrowed(&case.upstream(camera, part));
    backend
        .differentiate(&case.cameras[camera], case.background, case.sh_degree, &upstream)
        .expect("a small image is rendered")
}

#[test]
fn every_backend_reproduces_images_and_statistics() {
    on_every_backend("images", |table, subject, case| {
        let mut backend = make(subject, &case.model);
        for camera in 0..case.cameras.len() {
            let (image, gradient) = differentiate(&mut *backend, case, camera, Part::Full);
            check_image(table, subject.limits(), case, camera, &image);
            check_statistics(table, tens(subject), case, camera, &gradient);
        }
    });
}

fn check_image(table: &mut Table, limits: Limits, case: &Case, camera: usize, image: &Rendering) {
    let close: Vec<bool> = case.decided(camera).iter().map(|ok| !ok).collect();
    let depth = case.of_camera("depth_acc", camera);
    let scale = depth.iter().fold(1.0_f64, |m, d| m.max(*d));
    // A flipped row changes depth by its share of the depth; elsewhere all three are held to
    // the same absolute difference.
    let deep = Limits { step: limits.step * scale, ..limits };
    let arrays = [
        ("rgb", &image.rgb, limits),
        ("alpha", &image.alpha, limits),
        ("depth_acc", &image.depth, deep),
    ];
    for (key, measured, limits) in arrays {
        let expected = case.of_camera(key, camera);
        table.image(&case.name, key, compare_images(measured, expected, &close, limits), limits);
    }
}

#[test]
fn every_backend_reproduces_gradients() {
    on_every_backend("gradients", |table, subject, case| {
        for part in Part::ALL {
            check_gradients(table, subject, case, part);
        }
    });
}

/// Stored gradients of parameters are sums over cameras, those on the screen are per camera.
fn check_gradients(table: &mut Table, subject: &Subject, case: &Case, part: Part) {
    let mut backend = make(subject, &case.model);
    let mut sums: Vec<Vec<f64>> = Vec::new();
    let prefix = format!("grad_{}", part.key());
    let mut check = |key: &str, measured: &[f64], expected: &[f64]| {
        let tolerance = tens(subject) * case.tolerance(key);
        table.check(&case.name, key, relative_error(measured, expected), tolerance);
    };
    for camera in 0..case.cameras.len() {
        let (_, gradient) = differentiate(&mut *backend, case, camera, part);
        let classes: Vec<Vec<f64>> = CLASSES.map(|c| wide(class(&gradient, c))).into();
        if sums.is_empty() {
            sums = classes;
        } else {
            for (sum, class) in sums.iter_mut().zip(classes) {
                sum.iter_mut().zip(class).for_each(|(s, g)| *s += g);
            }
        }
        let mut on_screen = |name: &str, measured: &[f32]| {
            let key = format!("{prefix}.{name}");
            check(&key, &wide(measured), case.of_camera(&key, camera));
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

/// Stored statistics leave out pixels with a close decision; the backend's cannot. So each lies
/// between the stored value and that value plus what those pixels could add.
fn check_statistics(
    table: &mut Table,
    tens: f64,
    case: &Case,
    camera: usize,
    found: &ModelGradient,
) {
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
        table.check(&case.name, "max_weight", off, tens * case.tolerance("max_weight"));

        let (value, least) = (f64::from(found.sum_weight[row]), stored("sum_weight")[row]);
        let off = beyond(value, least, least + sum) / least.max(1.0);
        table.check(&case.name, "sum_weight", off, tens * case.tolerance("max_weight"));

        let (value, least) = (f64::from(found.pixel_count[row]), stored("n_pixels")[row]);
        let off = beyond(value, least, least + f64::from(pixels));
        table.check(&case.name, "n_pixels", off, 0.0);

        if found.visible[row] != (stored("visible")[row] > 0.0) {
            let name = &case.name;
            table.fail(format!("{name}: row {row} in view {camera}: visible is wrong"));
        }
    }
}
