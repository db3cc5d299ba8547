//! Degrees against directions that are looked at one by one, and what a backend then holds.

#![expect(clippy::float_cmp, reason = "numbers are moved, not computed")]

use densify_policies::policy::{Needs, Signal, SignalSet};

use super::*;
use crate::backend::cpu::blocks::planes;
use crate::backend::cpu::budget::ledger;
use crate::backend::cpu::{Backend, CpuOptions};
use crate::backend::{MomentStorage, ParameterStorage, Shortcuts, Storage};
use crate::gaussians::Gaussians;
use crate::sh;

/// Root mean square over all directions of the distance of two colours, by looking at many: the points
/// of a spiral on the sphere, each for as much of it.
fn distance(sh: &[f64], degree: u8) -> f64 {
    let count = 20_000;
    let mut sum = 0.0;
    for i in 0..count {
        let z = 1.0 - (2.0 * f64::from(i) + 1.0) / f64::from(count);
        let turn = f64::from(i) * PI * (3.0 - 5.0_f64.sqrt());
        let radius = (1.0 - z * z).sqrt();
        let d = [radius * turn.cos(), radius * turn.sin(), z].map(|x| x as f32);
        let mut y = [0.0_f32; 16];
        y[0] = sh::C0;
        sh::basis(3, d, &mut y);
        for channel in 0..3 {
            let beyond = sh_coefficients(degree)..16;
            let off: f64 = beyond.map(|k| f64::from(y[k]) * sh[3 * k + channel]).sum();
            sum += off * off / f64::from(count);
        }
    }
    sum.sqrt()
}

#[test]
fn a_degree_is_the_lowest_within_the_tolerance() {
    let sh: Vec<f64> = (0..48).map(|i| 0.07 * (f64::from(i) * 1.3).sin()).collect();
    for degree in 0..3_u8 {
        let exact = distance(&sh, degree) * 255.0 / 3.0_f64.sqrt();
        let at = |share: f64| degree_needed(|i| sh[i], 3, (exact * share) as f32);
        assert_eq!((at(1.001), at(0.999)), (degree, degree + 1), "{exact}/255 at degree {degree}");
    }
    // What is not in use does not count; what is no number is kept.
    assert_eq!(degree_needed(|i| if i < 27 { 0.0 } else { 1.0 }, 2, 1.0), 0);
    assert_eq!(degree_needed(|i| if i == 30 { f64::NAN } else { 0.0 }, 3, 32.0), 3);
    assert_eq!(degree_needed(|_| f64::INFINITY, 1, 32.0), 1);
    assert_eq!(degree_needed(|_| 1.0, 0, 1.0), 0);
}

#[test]
fn rows_are_put_in_order_as_a_list_is() {
    let degrees = [0, 3, 1, 3, 0, 2, 1, 3, 0, 0, 2];
    let order = by_falling(&degrees);
    assert_eq!(order, [1, 3, 7, 5, 10, 2, 6, 0, 4, 8, 9]);
    let mut rows: Vec<u32> = (0..11).collect();
    let expected: Vec<u32> = order.clone();
    arrange(order, |a, b| rows.swap(a, b));
    assert_eq!(rows, expected);
    arrange(Vec::new(), |_, _| panic!("there is nothing to swap"));
}

/// A row whose colour needs a degree: 0.2 in the first coefficient of its highest band.
fn model(degrees: &[u8]) -> Gaussians {
    let rows = degrees.len();
    let mut sh = vec![0.0; 48 * rows];
    for (row, &degree) in degrees.iter().enumerate() {
        sh[48 * row] = row as f32;
        if degree > 0 {
            sh[48 * row + 3 * sh_coefficients(degree - 1)] = 0.2;
        }
    }
    Gaussians {
        sh_degree: 3,
        means: (0..rows).map(|row| [row as f32, 0.0, 0.0]).collect(),
        log_scales: vec![[-3.0; 3]; rows],
        quats: vec![[1.0, 0.0, 0.0, 0.0]; rows],
        opacity_logits: vec![0.5; rows],
        sh,
    }
}

fn options(storage: Storage, budget: usize) -> CpuOptions {
    let shortcuts = Shortcuts { row_degrees: Some(3.0), ..Shortcuts::default() };
    let needs = Needs { signals: SignalSet::of(&[Signal::ScreenGradient]), ..Needs::default() };
    CpuOptions { storage, shortcuts, needs, threads: Some(1), ..CpuOptions::new(budget) }
}

fn backend(model: &Gaussians, storage: Storage, budget: usize) -> CpuBackend {
    CpuBackend::new(model, &options(storage, budget)).expect("a small model fits")
}

fn storages() -> Vec<Storage> {
    let moments =
        [MomentStorage::F32, MomentStorage::Bf16, MomentStorage::Ratio8, MomentStorage::Both8];
    let both = |parameters| moments.map(|moments| Storage { parameters, moments });
    [ParameterStorage::F32, ParameterStorage::F16].into_iter().flat_map(both).collect()
}

#[test]
fn what_is_held_falls_by_what_is_dropped() {
    // 20 rows of degree 3, 20 of 2, 8 of 1 and 32 of 0, mixed; in order, they make blocks of degrees
    // 3, 3, 2, 0 and 0.
    let sorted = [vec![3_u8; 20], vec![2; 20], vec![1; 8], vec![0; 32]].concat();
    let mixed: Vec<u8> = (0..80).map(|row| sorted[row * 37 % 80]).collect();
    let model = model(&mixed);
    for storage in storages() {
        let mut backend = backend(&model, storage, 16 * 8);
        let before = [backend.params.held(), backend.moments.held()];
        let found = backend.drop_bands(3).expect("it is native").expect("it was asked for");
        assert_eq!(found.rows, [32, 0, 16, 32], "{storage:?}");
        // The three blocks without rows are as the last one that has some.
        let planes = |base: usize| -> u64 {
            let of = |degree: u8| (planes(degree) - base) as u64;
            16 * (2 * of(3) + of(2) + 5 * of(0))
        };
        let (parameters, moments) = (storage.parameters, storage.moments);
        let expected = [
            match parameters {
                ParameterStorage::F32 => 4 * planes(0),
                ParameterStorage::F16 => 16 * 8 * (3 * 4 + 8 * 2) + 2 * planes(plane::SH),
            },
            planes(0)
                * match moments {
                    MomentStorage::F32 => 8,
                    MomentStorage::Bf16 => 4,
                    MomentStorage::Ratio8 => 3,
                    MomentStorage::Both8 => 2,
                },
        ];
        let held = [backend.params.held(), backend.moments.held()];
        assert_eq!(held, expected, "{storage:?}");
        assert_eq!(found.bytes, [before, held].map(|both| both[0] + both[1]));
        assert!(held[0] < before[0] && held[1] < before[1]);
        // The promise is what was needed at most.
        assert_eq!(*backend.ledger(), ledger(3, &options(storage, 16 * 8), 1));
        assert!(backend.drop_bands(3).expect("it is native").is_none(), "twice");
    }
}

#[test]
fn rows_go_with_all_that_is_theirs() {
    let degrees: Vec<u8> = (0..70).map(|row| [0, 3, 1, 2, 0][row % 5]).collect();
    let model = model(&degrees);
    for storage in storages() {
        let mut backend = backend(&model, storage, 80);
        for row in 0..70 {
            backend.ages[row] = row as u16;
            backend.signals.blocks.set(row, 0, row as f32);
        }
        let moments: Vec<f32> = (0..70 * 59).map(|i| (i / 59) as f32).collect();
        let is_wide = storage.moments == MomentStorage::F32;
        for name in ["moments.first", "moments.second"].into_iter().filter(|_| is_wide) {
            backend.restore(Tensor::f32(name, &[70, 59], moments.clone())).expect("an array");
        }
        let left = backend.drop_bands(3).expect("it is native").expect("it was asked for");
        assert_eq!(left.rows.iter().sum::<usize>(), 70);
        let order = by_falling(&degrees);
        let now = backend.download().expect("it is there");
        for (row, &was) in order.iter().enumerate() {
            let was = was as usize;
            assert_eq!(now.means[row].map(f32::to_bits), model.means[was].map(f32::to_bits));
            assert_eq!(backend.ages[row], was as u16);
            assert!(backend.signals.blocks.get(row, 0) == was as f32, "signals of row {row}");
            // All that it needs, and what it never had is 0.
            let near =
                now.sh_of(row).iter().zip(model.sh_of(was)).all(|(a, b)| (a - b).abs() < 1e-3);
            assert!(near, "{storage:?}: row {row}, once {was}");
            if is_wide {
                let planes = planes(backend.degree(row / WIDTH));
                for plane in 0..59 {
                    let expected = if plane < planes { was as f32 } else { 0.0 };
                    let [m, v] = backend.moments.get(row, plane);
                    assert!(m == expected && v == expected, "row {row}, once {was}: {plane}");
                }
            }
        }
    }
}

#[test]
fn nothing_changes_where_nothing_can_be_dropped() {
    let model = model(&[3, 0, 3, 1]);
    let mut whole = backend(&model, Storage::default(), 40);
    let left = whole.drop_bands(3).expect("it is native").expect("it was asked for");
    assert_eq!((left.rows, left.bytes[0]), ([0, 0, 0, 4], left.bytes[1]));
    assert!(whole.download().expect("it is there") == model, "another order");
    // What was not asked for.
    let options = CpuOptions::new(4);
    let mut backend = CpuBackend::new(&model, &options).expect("a small model fits");
    assert!(backend.drop_bands(0).expect("it is native").is_none());
    assert!(backend.download().expect("it is there") == model);
    assert!(!backend.state().iter().any(|array| array.name == "degrees"));
}

#[test]
fn bands_that_are_not_in_use_are_lost() {
    let mut backend = backend(&model(&[3, 2, 1, 0]), Storage::default(), 4);
    let left = backend.drop_bands(1).expect("it is native").expect("it was asked for");
    assert_eq!(left.rows, [0, 4, 0, 0]);
}

/// Degrees come from a file that cannot be trusted.
#[test]
fn degrees_that_cannot_be_are_refused() {
    let model = Gaussians { sh_degree: 2, ..model(&[2, 1]).up_to_degree(2) };
    let cases: [(&[u8], &str); 5] = [
        (&[3, 2, 0], "from 2 at most"),
        (&[255, 0, 0], "from 2 at most"),
        (&[2, 1, 2], "fall from block to block"),
        (&[2, 1], "[2]; this run needs [3]"),
        (&[2, 2, 1, 0], "[4]; this run needs [3]"),
    ];
    for (degrees, words) in cases {
        let mut backend = backend(&model, Storage::default(), 40);
        let tensor = Tensor::u8("degrees", &[degrees.len()], degrees.to_vec());
        let refused = backend.restore(tensor).expect_err("it is wrong").to_string();
        assert!(refused.contains(words) && refused.contains("`degrees`"), "{refused}");
        assert!(backend.params.degrees() == Degrees::ALL, "{degrees:?}");
    }
    let mut backend = backend(&model, Storage::default(), 40);
    let tensor = |degrees: [u8; 3]| Tensor::u8("degrees", &[3], degrees.to_vec());
    backend.restore(tensor([2, 2, 2])).expect("nothing is dropped");
    backend.restore(tensor([2, 1, 0])).expect("the first time");
    backend.restore(tensor([2, 1, 0])).expect("the same again");
    let refused = backend.restore(tensor([2, 0, 0])).expect_err("others").to_string();
    assert!(refused.contains("dropped other bands"), "{refused}");
    let kind = Tensor::f32("degrees", &[3], vec![0.0; 3]);
    assert!(backend.restore(kind).is_err());
}
