//! Parameters and moments in fewer bits: training is as good, repeats at any number of threads, goes
//! on from a checkpoint to the same bytes, and takes the memory that the ledger says.

use densify::backend::cpu::{CpuBackend, CpuOptions};
use densify::backend::{
    Backend, MomentStorage, ParameterStorage, StateArray, StepInput, Storage, Tensor,
};
use densify::camera::Camera;
use densify::dataset::images::Image8;
use densify::gaussians::Gaussians;
use densify_policies::plan::EditPlan;
use densify_policies::policy::{Cadence, SceneInfo};
use densify_policies::registry::find;

use crate::subject::RATES;
use densify::verify::scenes;

const GREY: [f32; 3] = [0.3, 0.4, 0.6];

/// All combinations but that of today's default.
fn storages() -> Vec<Storage> {
    let mut all = Vec::new();
    for parameters in [ParameterStorage::F32, ParameterStorage::F16] {
        for moments in [MomentStorage::F32, MomentStorage::Both8] {
            all.push(Storage { parameters, moments });
        }
    }
    all.split_off(1)
}

fn backend(model: &Gaussians, storage: Storage, threads: usize) -> CpuBackend {
    let options =
        CpuOptions { storage, threads: Some(threads), ..CpuOptions::new(model.len() + 5) };
    CpuBackend::new(model, &options).expect("a small model fits")
}

/// The image of a model as a photograph.
fn photograph(model: &Gaussians, camera: &Camera) -> Image8 {
    let mut backend = backend(model, Storage::default(), 1);
    let rendering = backend.render(camera, GREY, model.sh_degree).expect("a small image");
    let rgb = rendering.rgb.iter().map(|x| (x.clamp(0.0, 1.0) * 255.0).round() as u8).collect();
    Image8 { width: camera.width, height: camera.height, rgb, alpha: None, mask: None }
}

/// Takes the steps of a range, and returns the mean loss of its last twenty.
fn train(
    backend: &mut CpuBackend,
    camera: &Camera,
    target: &Image8,
    steps: std::ops::RangeInclusive<u32>,
) -> f64 {
    let last = *steps.end();
    let mut sum = 0.0;
    for step in steps {
        let input = StepInput {
            step,
            view: 0,
            camera,
            target,
            background: GREY,
            sh_degree: 2,
            rates: RATES,
            cadence: Cadence::default(),
            seed: 7,
            ssim_weight: 1.0,
        };
        let output = backend.train_step(&input).expect("a small image is rendered");
        sum += if step + 20 > last { f64::from(output.loss) / 20.0 } else { 0.0 };
    }
    sum
}

/// The bits of what a run goes on from: the model, and the optimiser's state.
fn state(backend: &CpuBackend) -> (Gaussians, Vec<Tensor>) {
    let saved = |array: StateArray| backend.save(&array.name).expect("an array");
    let tensors = backend.state().into_iter().map(saved).collect();
    (backend.download().expect("a model"), tensors)
}

/// A model, and the photograph of another one whose colours are others.
fn scene() -> (Gaussians, Camera, Image8) {
    let camera = scenes::camera(64, 48, 11);
    let truth = scenes::cloud(400, 2, &camera, 12);
    let mut model = truth.clone();
    for (i, x) in model.sh.iter_mut().enumerate() {
        *x += 0.2 * (i as f32 * 1.7).sin();
    }
    for (i, scale) in model.log_scales.iter_mut().flatten().enumerate() {
        *scale += 0.1 * (i as f32 * 2.3).sin();
    }
    let target = photograph(&truth, &camera);
    (model, camera, target)
}

/// The loss falls as it does with f32, to a twentieth. At its end it wanders with the rounding. That
/// small steps are not lost, as they would be by rounding to the nearest, is held number by number in
/// `cpu/narrow/tests.rs`.
#[test]
fn training_is_as_good() {
    let (model, camera, target) = scene();
    let loss = |storage, steps| {
        let mut backend = backend(&model, storage, 1);
        train(&mut backend, &camera, &target, 1..=steps)
    };
    let (first, reference) = (loss(Storage::default(), 20), loss(Storage::default(), 400));
    assert!(reference < 0.2 * first, "{first} -> {reference}");
    let found: Vec<_> =
        storages().into_iter().map(|storage| (storage, loss(storage, 400))).collect();
    let bad: Vec<_> = found.iter().filter(|(_, loss)| *loss > 1.5 * reference).collect();
    assert!(bad.is_empty(), "f32: {first} -> {reference}, but {bad:?}");
}

#[test]
fn threads_change_nothing() {
    let (model, camera, target) = scene();
    for storage in storages() {
        let run = |threads| {
            let mut backend = backend(&model, storage, threads);
            train(&mut backend, &camera, &target, 1..=6);
            state(&backend)
        };
        let expected = run(1);
        assert!(run(2) == expected && run(5) == expected, "{storage:?}");
        // Draws depend on the seed and the step, and matter.
        let mut other = backend(&model, Storage::default(), 1);
        train(&mut other, &camera, &target, 1..=6);
        assert!(state(&other).0 != expected.0, "{storage:?}");
    }
}

/// What is stored comes back from a checkpoint to the bit, and so does everything after it.
#[test]
fn a_run_goes_on_to_the_same_bits() {
    let (model, camera, target) = scene();
    for storage in storages() {
        let mut whole = backend(&model, storage, 1);
        train(&mut whole, &camera, &target, 1..=7);
        let (saved, tensors) = state(&whole);
        let mut resumed = backend(&saved, storage, 1);
        for tensor in tensors.clone() {
            resumed.restore(tensor).expect("an array of this backend");
        }
        assert!(state(&resumed) == (saved, tensors), "{storage:?}: another state");
        train(&mut whole, &camera, &target, 8..=14);
        train(&mut resumed, &camera, &target, 8..=14);
        assert!(state(&whole) == state(&resumed), "{storage:?}: another future");
    }
}

/// Arrays of another storage are refused with what they are.
#[test]
fn moments_of_another_storage_are_refused() {
    let (model, ..) = scene();
    let of = |moments| backend(&model, Storage { moments, ..Storage::default() }, 1);
    let saved = of(MomentStorage::Both8).save("moments.first").expect("an array");
    let refused = of(MomentStorage::F32).restore(saved).expect_err("another type").to_string();
    assert!(refused.contains("`moments.first`: its type is U8; this run needs F32"), "{refused}");
}

/// A number that is not finite is found, wherever it is and however it is stored, and goes with its row.
#[test]
fn an_audit_sees_what_is_no_number() {
    let (model, camera, target) = scene();
    for storage in storages() {
        let mut poisoned = model.clone();
        poisoned.opacity_logits[3] = f32::NAN;
        poisoned.sh[27 * 20 + 4] = f32::INFINITY;
        // Beyond f16, and no reason to be removed.
        poisoned.sh[27 * 40] = -1e30;
        let mut backend = backend(&poisoned, storage, 1);
        train(&mut backend, &camera, &target, 1..=3);
        let found: Vec<u32> = backend.audit().expect("an audit").iter().map(|u| u.row).collect();
        assert_eq!(found, [3, 20], "{storage:?}");
    }
}

/// Bytes per row at degree 3 of all that lasts, for a policy with its default parameters.
fn bytes_per_row(policy: &str, storage: Storage, [pairs, records]: [f64; 2]) -> f64 {
    let scene = SceneInfo {
        extent: 1.0,
        train_views: 100,
        budget: 1 << 20,
        initial_rows: 1 << 16,
        iterations: 30_000,
        white_background: false,
    };
    let entry = find(policy).expect("a built-in policy");
    let needs = entry.build(&toml::Table::new(), &scene).expect("its defaults").needs(&scene);
    let total = |rows: usize| {
        let cap = |share: f64| (rows as f64 * share) as usize;
        let options = CpuOptions {
            storage,
            needs: needs.clone(),
            tile_cap: cap(pairs),
            record_cap: cap(records),
            ..CpuOptions::new(rows)
        };
        CpuBackend::promise(3, &options, 1).total()
    };
    (total(1 << 20) - total(1 << 19)) as f64 / f64::from(1 << 19)
}

/// What the preset `tiny-memory` leaves of what a row takes otherwise. What a policy's event takes
/// beside it is in `tests/it/cli/memory.rs`.
#[test]
fn a_row_takes_less_than_430_bytes() {
    let small = Storage { parameters: ParameterStorage::F16, moments: MomentStorage::Both8 };
    for policy in ["vanilla", "diet", "mcmc"] {
        let (today, least) = (
            bytes_per_row(policy, Storage::default(), [16.0, 16.0]),
            bytes_per_row(policy, small, [1.0, 0.4]),
        );
        assert!(least <= 430.0 && today > 1_500.0, "{policy}: {today}, {least}");
    }
}

/// With room for few records at a time, rows that were removed leave nothing behind in which the rest
/// would find its own.
#[test]
fn rows_that_are_gone_have_no_records() {
    let (model, camera, target) = scene();
    let run = |record_cap| {
        let options =
            CpuOptions { record_cap, threads: Some(1), ..CpuOptions::new(model.len() + 5) };
        let mut backend = CpuBackend::new(&model, &options).expect("a small model fits");
        train(&mut backend, &camera, &target, 1..=2);
        let mut plan = EditPlan::new(model.len(), model.len() + 5);
        for row in 10..model.len() as u32 {
            plan.prune(row).expect("each row once");
        }
        backend.apply(&plan.compile(), 7, 2).expect("an edit");
        train(&mut backend, &camera, &target, 3..=4);
        state(&backend)
    };
    // Enough for all records of the ten rows that stay, not for the slots of those that went.
    assert!(run(200) == run(1 << 20));
}
