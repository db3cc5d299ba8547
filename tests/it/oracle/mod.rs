//! Compares the float64 renderer and every backend with stored float64 renders and gradients of small scenes.
//! Tolerances: 1e-9 for the renderer; 2e-5 (1e-4 on a GPU) for images of backends, except in pixels near a threshold;
//! ten times the error of float32 arithmetic (twenty times on a GPU or without SIMD) for gradients and statistics of
//! backends.

mod case;

use densify::render::cpu::InstructionSet;
use densify::selftest::compare::{Table, relative_error};
use densify::selftest::reference::blend::leeway;
use densify::selftest::reference::project::{by_depth, project};
use densify::selftest::reference::{CLASSES, Model, Rules, ScreenGradient, View, differentiate};
use densify::selftest::{Subject, scenes};

use crate::subject::{all, class, make, wide};
use case::{Case, Part, cases};

/// Tolerance of float64 computations in a different order, for scenes that include needles of 1000:1.
const EXACT: f64 = 1e-9;

/// Images of one camera and gradients of part of the loss.
struct Results {
    /// Keyed by the names of the stored arrays.
    images: [(&'static str, Vec<f64>); 3],
    /// In the order of [`CLASSES`].
    classes: Vec<Vec<f64>>,
    mean2d: Vec<f64>,
    mean2d_abs: Vec<f64>,
    colour: Vec<f64>,
    max_weight: Vec<f64>,
    sum_weight: Vec<f64>,
    pixels: Vec<f64>,
}

fn view(case: &Case, camera: usize) -> View<'_> {
    let background = case.background.map(f64::from);
    View { camera: &case.cameras[camera], background, sh_degree: case.sh_degree }
}

fn by_reference(case: &Case, camera: usize, part: Part) -> Results {
    let upstream = case.upstream(camera, part);
    let (image, gradient) =
        differentiate(&Model::from(&case.model), view(case, camera), &Rules::STANDARD, &upstream);
    // The stored set of pixels near a threshold includes that of the renderer.
    let pixels = image.boundary.iter().zip(case.away_from_thresholds(camera));
    assert!(pixels.into_iter().all(|(close, away)| !(*close && away)), "{}", case.name);
    let flat = |of: fn(&ScreenGradient) -> Vec<f64>| gradient.screen.iter().flat_map(of).collect();
    Results {
        images: [("rgb", image.rgb), ("alpha", image.alpha), ("depth_acc", image.depth)],
        classes: CLASSES.map(|class| gradient.model.class(class).to_vec()).into(),
        mean2d: flat(|row| row.mean.to_vec()),
        mean2d_abs: flat(|row| row.mean_abs.to_vec()),
        colour: flat(|row| row.colour.to_vec()),
        max_weight: flat(|row| vec![row.max_weight]),
        sum_weight: flat(|row| vec![row.sum_weight]),
        pixels: flat(|row| vec![row.pixels.into()]),
    }
}

fn by_backend(subject: &Subject, case: &Case, camera: usize, part: Part) -> Results {
    let upstream = scenes::narrowed(&case.upstream(camera, part));
    let (image, gradient) = make(subject, &case.model)
        .differentiate(&case.cameras[camera], case.background, case.sh_degree, &upstream)
        .expect("a small image is rendered");
    Results {
        images: [
            ("rgb", wide(&image.rgb)),
            ("alpha", wide(&image.alpha)),
            ("depth_acc", wide(&image.depth)),
        ],
        classes: CLASSES.map(|name| wide(class(&gradient, name))).into(),
        mean2d: wide(gradient.mean2d.as_flattened()),
        mean2d_abs: wide(gradient.mean2d_abs.as_flattened()),
        colour: wide(gradient.colour.as_flattened()),
        max_weight: wide(&gradient.max_weight),
        sum_weight: wide(&gradient.sum_weight),
        pixels: gradient.pixel_count.iter().copied().map(f64::from).collect(),
    }
}

/// Compares the results of all cases: images with `image_tolerance`, gradients and statistics with the `tolerance` of a
/// case and a key.
fn check(
    subject: &str,
    compute: impl Fn(&Case, usize, Part) -> Results,
    image_tolerance: f64,
    tolerance: impl Fn(&Case, &str) -> f64,
) {
    let mut table = Table::new(&format!("{subject} against stored arrays"));
    for case in &cases() {
        for part in Part::ALL {
            let prefix = format!("grad_{}", part.key());
            let mut figure = |key: &str, measured: &[f64], expected: &[f64]| {
                let error = relative_error(measured, expected);
                table.check(&case.name, key, error, tolerance(case, key));
            };
            // Stored parameter gradients are summed over cameras; screen gradients are per camera.
            let mut sums: Vec<Vec<f64>> = Vec::new();
            let cameras = 0..case.cameras.len();
            let views: Vec<Results> = cameras.map(|camera| compute(case, camera, part)).collect();
            for (camera, results) in views.iter().enumerate() {
                sums.resize(CLASSES.len(), Vec::new());
                for (sum, class) in sums.iter_mut().zip(&results.classes) {
                    sum.resize(class.len(), 0.0);
                    sum.iter_mut().zip(class).for_each(|(sum, g)| *sum += g);
                }
                let mut on_screen = |name: &str, measured: &[f64]| {
                    let key = format!("{prefix}.{name}");
                    figure(&key, measured, case.of_camera(&key, camera));
                };
                if matches!(part, Part::Colour | Part::Full) {
                    on_screen("mean2d", &results.mean2d);
                    on_screen("mean2d_abs", &results.mean2d_abs);
                }
                if part == Part::Colour {
                    on_screen("g_color", &results.colour);
                }
            }
            for (class, sum) in CLASSES.iter().zip(&sums) {
                let key = format!("{prefix}.{class}");
                figure(&key, sum, case.expected(&key));
            }
            if part == Part::Full {
                for (camera, results) in views.iter().enumerate() {
                    check_images(&mut table, case, camera, results, image_tolerance);
                    let tolerance = tolerance(case, "max_weight");
                    check_statistics(&mut table, case, camera, results, tolerance);
                }
            }
        }
    }
    table.finish();
}

/// Compares images away from thresholds by absolute difference; depth relative to the deepest pixel.
fn check_images(table: &mut Table, case: &Case, camera: usize, results: &Results, tolerance: f64) {
    let away = case.away_from_thresholds(camera);
    for (key, measured) in &results.images {
        let expected = case.of_camera(key, camera);
        let channels = measured.len() / away.len();
        let scale = expected.iter().fold(1.0_f64, |most, value| most.max(value.abs()));
        let pixels = measured.iter().zip(expected).enumerate();
        let pixels = pixels.filter(|(i, _)| away[i / channels]);
        let errors = pixels.map(|(_, (a, b))| (a - b).abs());
        let larger =
            |most: f64, error: f64| if error > most || error.is_nan() { error } else { most };
        let worst = errors.fold(0.0, larger);
        table.check(&case.name, key, worst / scale, tolerance);
    }
}

/// Stored statistics omit pixels near a threshold, but computed ones cannot. Each must lie between the stored value and
/// that value plus the largest possible contribution of the omitted pixels.
fn check_statistics(table: &mut Table, case: &Case, camera: usize, results: &Results, limit: f64) {
    let splats = project(&Model::from(&case.model), view(case, camera), &Rules::STANDARD);
    let away = case.away_from_thresholds(camera);
    let leeways = leeway(&splats, &by_depth(&splats), view(case, camera), &away);
    let beyond = |value: f64, from: f64, to: f64| (from - value).max(value - to).max(0.0);
    let stored = |key: &str, row: usize| case.of_camera(key, camera)[row];
    for (row, &(max, sum, pixels)) in leeways.iter().enumerate() {
        let least = stored("max_weight", row);
        let error = beyond(results.max_weight[row], least, least.max(max));
        table.check(&case.name, "max_weight", error, limit);
        let least = stored("sum_weight", row);
        let error = beyond(results.sum_weight[row], least, least + sum) / least.max(1.0);
        table.check(&case.name, "sum_weight", error, limit);
        let least = stored("n_pixels", row);
        let error = beyond(results.pixels[row], least, least + f64::from(pixels));
        table.check(&case.name, "n_pixels", error, 0.0);
    }
}

#[test]
fn the_reference_reproduces_every_stored_array() {
    check("reference", by_reference, EXACT, |_, _| EXACT);
}

#[test]
fn every_backend_reproduces_every_stored_array() {
    for subject in all() {
        // Twice the tolerance where products may be rounded before adding, without fused multiply-add.
        let factor = match subject {
            Subject::Gpu(_) | Subject::Native { instructions: InstructionSet::Scalar, .. } => 2.0,
            Subject::Native { .. } => 1.0,
        };
        let compute = |case: &Case, camera, part| by_backend(&subject, case, camera, part);
        let tolerance = |case: &Case, key: &str| factor * case.tolerance(key);
        check(&subject.name(), compute, subject.limits().interior, tolerance);
    }
}
