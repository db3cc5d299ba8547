//! Rows that have lost bands of colour: images change by no more than was allowed, gradients are those
//! of a model whose bands are zero, and nothing else about a run is different: threads, checkpoints and
//! fewer bits.

use densify::backend::cpu::{CpuBackend, CpuOptions};
use densify::backend::{
    Backend, MomentStorage, ParameterStorage, Shortcuts, StateArray, StepInput, Storage, Tensor,
};
use densify::camera::Camera;
use densify::dataset::images::Image8;
use densify::gaussians::{Gaussians, sh_coefficients};
use densify_policies::policy::{Cadence, Needs, Signal, SignalSet};

use crate::subject::RATES;
use densify::verify::compare::{Limits, Table, class, compare_images, relative_error};
use densify::verify::reference::{CLASSES, Model, Rules, View, blend, project};
use densify::verify::scenes;

const GREY: [f32; 3] = [0.3, 0.4, 0.6];
const ROWS: usize = 170;

/// A model of degree 3 whose rows need all degrees: bands are weaker from row to row, in a mixed order,
/// and a fifth of the rows has next to none.
fn scene() -> (Gaussians, Camera) {
    let camera = scenes::camera(52, 41, 5);
    let mut model = scenes::cloud(ROWS, 3, &camera, 8);
    for (row, sh) in model.sh.chunks_exact_mut(48).enumerate() {
        let strength = if row % 5 == 0 { 1e-6 } else { 0.98_f32.powi((row * 29 % ROWS) as i32) };
        for (band, scale) in [(1, 1.0), (2, 0.7), (3, 0.6)] {
            let factor = scale * strength;
            let coefficients = 3 * sh_coefficients(band - 1)..3 * sh_coefficients(band);
            sh[coefficients].iter_mut().for_each(|x| *x *= factor);
        }
    }
    (model, camera)
}

fn options(tolerance: f32) -> CpuOptions {
    let needs = Needs {
        signals: SignalSet::of(&[Signal::ScreenGradient, Signal::WeightMax]),
        cadence: Cadence { all: 2, sh_rest: 3 },
        ..Needs::default()
    };
    let shortcuts = Shortcuts { row_degrees: Some(tolerance), ..Shortcuts::default() };
    CpuOptions { needs, shortcuts, threads: Some(1), ..CpuOptions::new(ROWS + 9) }
}

fn backend(model: &Gaussians, options: &CpuOptions) -> CpuBackend {
    CpuBackend::new(model, options).expect("a small model fits")
}

/// Drops bands; the rows of each degree.
fn drop_bands(backend: &mut CpuBackend) -> [usize; 4] {
    backend.drop_bands(3).expect("it is native").expect("it was asked for").rows
}

fn train(backend: &mut CpuBackend, camera: &Camera, steps: std::ops::RangeInclusive<u32>) {
    let target: Image8 = scenes::target(camera);
    for step in steps {
        let input = StepInput {
            step,
            view: 0,
            camera,
            target: &target,
            background: GREY,
            sh_degree: 3,
            rates: RATES,
            cadence: Cadence { all: 1 + step % 2, sh_rest: 3 },
            seed: 7,
            ssim_weight: 1.0,
        };
        backend.train_step(&input).expect("a small image is rendered");
    }
}

fn state(backend: &CpuBackend) -> (Gaussians, Vec<Tensor>) {
    let saved = |array: StateArray| backend.save(&array.name).expect("an array");
    let tensors = backend.state().into_iter().map(saved).collect();
    (backend.download().expect("a model"), tensors)
}

/// What a pixel may change where colours change by `tolerance` (rms over directions): by the addition
/// theorem the sum of squares of all Y of bands 1 to 3 is 15/4π in any direction, and colours are blended
/// with weights whose sum is 1 at most.
fn most(tolerance: f32) -> f64 {
    f64::from(tolerance) / 255.0 * 3.0_f64.sqrt() * 15.0_f64.sqrt()
}

#[test]
fn images_change_by_no_more_than_is_allowed() {
    let (model, camera) = scene();
    for (tolerance, lowest) in [(0.01, 20), (2.0, 40), (6.0, 80)] {
        let mut backend = backend(&model, &options(tolerance));
        let before = backend.render(&camera, GREY, 3).expect("a small image");
        let rows = drop_bands(&mut backend);
        assert!(rows[..3].iter().sum::<usize>() >= lowest && rows[3] > 0, "{tolerance}: {rows:?}");
        let after = backend.render(&camera, GREY, 3).expect("a small image");
        let off = |(a, b): (&[f32], &[f32])| -> f64 {
            let squares = a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2));
            squares.sum::<f64>().sqrt()
        };
        let pixels = before.rgb.chunks(3).zip(after.rgb.chunks(3));
        let largest = pixels.map(off).fold(0.0, f64::max);
        // Rounding, as elsewhere, and equal depths in another order.
        assert!(largest <= most(tolerance) + 1e-5, "{tolerance}: {largest}");
        // It is the colours that have changed, where anything has.
        assert!(tolerance < 0.1 || largest > 1e-4, "{tolerance}: nothing was dropped");
        let alike = |a: &[f32], b: &[f32]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-5);
        assert!(alike(&before.alpha, &after.alpha), "{tolerance}");
        // What is rendered is what is saved.
        let saved = backend.download().expect("a model");
        let mut plain = self::backend(&saved, &options(tolerance));
        let again = plain.render(&camera, GREY, 3).expect("a small image");
        assert!(again == after, "{tolerance}: another model is saved");
    }
}

/// Of the bands that are left, the gradients are those of the reference with the others at zero; of the
/// others they are zero.
#[test]
fn gradients_are_those_of_the_bands_that_are_left() {
    let (model, camera) = scene();
    let mut table = Table::new("rows of several degrees");
    let narrow = Storage { parameters: ParameterStorage::F16, moments: MomentStorage::Ratio8 };
    for (name, storage) in [("f32", Storage::default()), ("f16", narrow)] {
        let mut backend = backend(&model, &CpuOptions { storage, ..options(6.0) });
        let rows = drop_bands(&mut backend);
        assert!(rows.iter().filter(|rows| **rows > 0).count() >= 3, "{rows:?}");
        let now = backend.download().expect("a model");
        let view = View { camera: &camera, background: GREY.map(f64::from), sh_degree: 3 };
        let (exact, rules) = (Model::of(&now), Rules::STANDARD);
        let splats = project::project(&exact, view, &rules);
        let order = project::by_depth(&splats);
        let image = blend::render(&splats, &order, view, &rules);
        let upstream = scenes::upstream(&camera, 99).ignoring(&image.boundary);
        let screen = blend::backward(&splats, &order, view, &rules, &upstream);
        let mut expected = project::backward(&exact, view, &splats, &screen);
        let (rendering, found) = backend
            .differentiate(&camera, GREY, 3, &scenes::narrowed(&upstream))
            .expect("a small image");
        let outcome = compare_images(&rendering.rgb, &image.rgb, &image.boundary, Limits::CPU);
        table.image(name, "rgb", outcome, Limits::CPU);
        // Blocks of falling degree, as rows are in order.
        let degrees =
            backend.save("degrees").expect("an array").into_u8(&[(ROWS + 9).div_ceil(16)]);
        let degrees = degrees.expect("one per block");
        assert!(degrees.is_sorted_by(|a, b| a >= b), "{degrees:?}");
        for row in 0..ROWS {
            let lost = 48 * row + 3 * sh_coefficients(degrees[row / 16])..48 * (row + 1);
            assert!(found.sh[lost.clone()].iter().all(|g| *g == 0.0), "{name}: row {row}");
            assert!(now.sh[lost.clone()].iter().all(|x| *x == 0.0), "{name}: row {row}");
            expected.sh[lost].fill(0.0);
        }
        for of in CLASSES {
            let error = relative_error(class(&found, of), expected.class(of));
            table.check(name, of, error, 1e-4);
        }
    }
    table.finish();
}

/// Training goes on, with sums between steps, bands at steps of their own, and signals: the same bits at
/// any number of threads, and from a checkpoint before bands are dropped or after.
#[test]
fn nothing_depends_on_threads_or_on_a_stop() {
    let (model, camera) = scene();
    let narrow = Storage { parameters: ParameterStorage::F16, moments: MomentStorage::Ratio8 };
    for storage in [Storage::default(), narrow] {
        let options = CpuOptions { storage, ..options(3.0) };
        let finish = |backend: &mut CpuBackend| {
            train(backend, &camera, 10..=16);
            state(backend)
        };
        let run = |threads| {
            let mut backend =
                backend(&model, &CpuOptions { threads: Some(threads), ..options.clone() });
            train(&mut backend, &camera, 1..=7);
            let before = state(&backend);
            let rows = drop_bands(&mut backend);
            train(&mut backend, &camera, 8..=9);
            let after = state(&backend);
            (before, rows, after, finish(&mut backend))
        };
        let (before, rows, after, end) = run(1);
        assert!(rows[..3].iter().sum::<usize>() > 40 && rows[3] > 0, "{rows:?}");
        for threads in [2, 5] {
            assert!(
                run(threads) == (before.clone(), rows, after.clone(), end.clone()),
                "{threads}"
            );
        }
        let resumed = |(model, tensors): &(Gaussians, Vec<Tensor>)| {
            let mut backend = backend(model, &options);
            for tensor in tensors.clone() {
                backend.restore(tensor).expect("an array of this backend");
            }
            assert!(state(&backend) == (model.clone(), tensors.clone()), "another state");
            backend
        };
        let mut early = resumed(&before);
        assert_eq!(drop_bands(&mut early), rows);
        train(&mut early, &camera, 8..=9);
        assert!(state(&early) == after, "{storage:?}: another future from before");
        let mut late = resumed(&after);
        assert!(finish(&mut late) == end, "{storage:?}: another future from after");
        assert!(late.drop_bands(3).expect("it is native").is_none(), "twice");
    }
}

/// A number that is none is found where bands were dropped, and kept from being dropped.
#[test]
fn an_audit_sees_all_blocks() {
    let (mut model, _) = scene();
    model.sh[48 * 100 + 47] = f32::NAN;
    model.sh[48 * 20 + 1] = f32::INFINITY;
    for parameters in [ParameterStorage::F32, ParameterStorage::F16] {
        let storage = Storage { parameters, ..Storage::default() };
        let mut backend = backend(&model, &CpuOptions { storage, ..options(32.0) });
        drop_bands(&mut backend);
        let found = backend.audit().expect("an audit");
        let now = backend.download().expect("a model");
        let bad: Vec<u32> = (0..ROWS as u32)
            .filter(|&row| !now.sh_of(row as usize).iter().all(|x| x.is_finite()))
            .collect();
        assert_eq!(found.iter().map(|u| u.row).collect::<Vec<_>>(), bad);
        assert_eq!(bad.len(), 2, "{parameters:?}");
    }
}
