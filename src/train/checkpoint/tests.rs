//! Tests of checkpoint files: round trips, and refusal of damaged files.

use std::io::{Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

use densify_policies::policy::{
    Cadence, CandidateRequest, DepthMode, ErrorMode, Needs, Signal, SignalSet,
};
use glam::DVec3;
use safetensors::SafeTensors;

use super::*;
use densify_core::antialiasing::Antialiasing;
use densify_core::gaussians::Gaussians;
use densify_core::pieces::ROWS_AT_A_TIME;
use densify_data::dataset::normalise::Normalisation;
use densify_render::Setup;
use densify_render::cpu::CpuBackend;
use densify_render::{Backend, StateArray, Tensor, Values};

/// Number of rows: few, so that every byte of a file can be damaged in turn.
const ROWS: usize = 61;

fn numbers(count: usize, seed: f32) -> Vec<f32> {
    (0..count).map(|i| ((i as f32 + seed) * 0.7131).sin()).collect()
}

fn gaussians(rows: usize) -> Gaussians {
    let by = |n: usize, seed| numbers(n * rows, seed);
    Gaussians {
        sh_degree: 1,
        origin: [0.0; 3],
        antialiasing: Antialiasing::None,
        means: by(3, 1.0).as_chunks().0.to_vec(),
        log_scales: by(3, 2.0).as_chunks().0.to_vec(),
        quats: by(4, 3.0).as_chunks().0.to_vec(),
        opacity_logits: by(1, 4.0),
        sh: by(12, 5.0),
    }
}

fn options(rows: usize) -> Setup {
    let candidates = CandidateRequest {
        from: 0,
        until: 9,
        rows_per_candidate: 1,
        capacity: 5,
        error: ErrorMode::L1,
        depth: DepthMode::Median,
        min_alpha: 0.5,
        spaced: false,
    };
    let needs = Needs {
        signals: SignalSet::from([Signal::WeightMax, Signal::MeanGradientX, Signal::Age]),
        candidates: Some(candidates),
        cadence: Cadence { all: 2, sh_rest: 4 },
        ..Needs::default()
    };
    Setup { needs, threads: Some(1), ..Setup::new(rows + 3) }
}

/// A backend with arbitrary values in every array of its state, as during a run.
fn backend(rows: usize) -> CpuBackend {
    let mut backend = CpuBackend::new(&gaussians(rows), &options(rows)).unwrap();
    for (i, StateArray { name, .. }) in backend.state().into_iter().enumerate() {
        let Tensor { mut shape, values, .. } = backend.save(&name).unwrap();
        if name == "candidates" {
            shape[0] = 4;
        }
        let count = shape.iter().product();
        let values = match values {
            Values::F32(_) => Values::F32(numbers(count, i as f32)),
            Values::U16(_) => Values::U16((0..count).map(|k| (k * 31 + i) as u16).collect()),
            Values::U8(_) => Values::U8((0..count).map(|k| (k % 2) as u8).collect()),
        };
        backend.restore(Tensor { name, shape, values }).unwrap();
    }
    backend
}

fn header(rows: usize) -> Header {
    let views = ViewsFingerprint { count: 3, names: 1, cameras: 2, images: 3 };
    Header {
        densify: "0.1.0".into(),
        budget: rows + 3,
        sh_degree: 1,
        config: toml::toml! { near = 0.30000000000000004 seed = 2000000000 },
        dataset: Fingerprint {
            train: views.clone(),
            test: views,
            normalisation: Normalisation { centre: DVec3::new(0.1, 2e-300, 7.0), scale: 1.0 / 3.0 },
        },
        trainer: crate::trainer::TrainerState {
            exposures: Some(crate::exposure::Exposures::new(
                crate::exposure::ExposureModel::Matrix,
                &[[0.1, 1.0 / 3.0, f32::MIN_POSITIVE]; 3],
            )),
            step: 17,
            initial_rows: 9,
            peak_rows: rows,
            extra_forwards: 4,
            policy_time: Duration::from_nanos(1_234_567_891),
            policy: serde_json::json!({ "seen": [0.1, 1.0 / 3.0, 5e-324, 1e308] }),
            ..crate::trainer::TrainerState::default()
        },
        session: serde_json::json!({ "sum": 0.1_f32 + 0.2_f32 }),
    }
}

/// Writes a checkpoint to its own folder.
fn written() -> (tempfile::TempDir, PathBuf) {
    written_with(ROWS)
}

fn written_with(rows: usize) -> (tempfile::TempDir, PathBuf) {
    let root = tempfile::tempdir().unwrap();
    let path = checkpoint_path(root.path(), 17);
    write(&path, &header(rows), &backend(rows)).unwrap();
    (root, path)
}

#[test]
fn ages_of_rows_are_read_without_a_backend() {
    let (_root, path) = written();
    let ages = Checkpoint::open(&path).unwrap().ages().unwrap();
    let signals = backend(ROWS).take_signals(SignalSet::from([Signal::Age])).unwrap();
    let counted: Vec<f32> = ages.iter().map(|&age| age as f32).collect();
    assert_eq!(signals.get(Signal::Age), Some(&*counted));
    assert!(ages.len() == ROWS && ages[1] > ages[0]);
}

fn problem(path: &Path) -> String {
    Checkpoint::open(path).unwrap_err().to_string()
}

#[test]
fn checkpoints_are_read_back_bit_for_bit() {
    // The second is written in more than one piece.
    for rows in [ROWS, ROWS_AT_A_TIME + 13] {
        let (_root, path) = written_with(rows);
        let mut checkpoint = Checkpoint::open(&path).unwrap();
        assert_eq!(*checkpoint.header(), header(rows));
        let blank = checkpoint.blank_model().unwrap();
        let mut restored = CpuBackend::new(&blank, &options(rows)).unwrap();
        checkpoint.restore(&mut restored).unwrap();
        assert_eq!(restored.download().unwrap(), gaussians(rows));
        let expected = backend(rows);
        assert_eq!(restored.state().len(), 10);
        for StateArray { name, .. } in expected.state() {
            assert_eq!(restored.save(&name).unwrap(), expected.save(&name).unwrap(), "{name}");
        }
    }
}

#[test]
fn equal_states_give_equal_files() {
    let [(_one, a), (_other, b)] = [written(), written()];
    assert!(std::fs::read(a).unwrap() == std::fs::read(b).unwrap());
}

#[test]
fn the_safetensors_library_reads_the_arrays() {
    let (_root, path) = written();
    let bytes = std::fs::read(&path).unwrap();
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let scales = file.tensor("model.log_scales").unwrap();
    assert_eq!(scales.shape(), [ROWS, 3]);
    let first = f32::from_le_bytes(scales.data()[..4].try_into().unwrap());
    assert_eq!(first.to_bits(), gaussians(ROWS).log_scales[0][0].to_bits());
    assert_eq!(file.tensor("moments.second").unwrap().shape(), [ROWS, 23]);
}

#[test]
fn truncated_files_are_refused() {
    let (_root, path) = written();
    let mut file = std::fs::OpenOptions::new().append(true).open(&path).unwrap();
    let size = file.metadata().unwrap().len();
    file.write_all(b"x").unwrap();
    assert!(problem(&path).contains("too long"));
    for length in (0..size).rev().filter(|at| at % 7 == 0 || size - at < 50) {
        file.set_len(length).unwrap();
        let problem = problem(&path);
        assert!(problem.contains("17.safetensors: it is cut short"), "{length}: {problem}");
    }
}

/// Flips one bit in every `step`-th byte from `first` on.
fn flip_bits(first: usize, step: usize) {
    let (_root, path) = written();
    let bytes = std::fs::read(&path).unwrap();
    let mut file = std::fs::OpenOptions::new().write(true).open(&path).unwrap();
    let mut set = |at: usize, byte: u8| {
        file.seek(SeekFrom::Start(at as u64)).unwrap();
        file.write_all(&[byte]).unwrap();
    };
    for at in (first..bytes.len()).step_by(step) {
        set(at, bytes[at] ^ (1 << (at % 8)));
        let problem = problem(&path);
        assert!(problem.contains("iteration_17.safetensors: "), "{at}: {problem}");
        set(at, bytes[at]);
    }
    let last = bytes.len() - 1;
    set(last, bytes[last] ^ 1);
    assert!(problem(&path).contains("`summed.rest_ages` is damaged: its checksum"));
}

#[test]
fn flipped_bits_are_refused() {
    flip_bits(5, 41);
}

#[test]
#[ignore = "takes minutes: run by .ci/run"]
fn every_flipped_bit_is_refused() {
    flip_bits(0, 1);
}

#[test]
fn headers_with_excessive_sizes_are_refused_without_allocation() {
    let root = tempfile::tempdir().unwrap();
    let path = root.path().join("c.safetensors");
    let check = |length: u64, header: &str, words: &str| {
        std::fs::write(&path, [&length.to_le_bytes()[..], header.as_bytes()].concat()).unwrap();
        let problem = problem(&path);
        assert!(problem.contains(words), "{header}: {problem}");
    };
    check(u64::MAX, "{}", "larger than 64 MiB");
    check(60 << 20, "{}", "cut short");
    check(2, "{}", "not a checkpoint of densify: its header has no `densify.version`");
    let newer = r#"{"__metadata__":{"densify.version":"99"}}"#;
    check(newer.len() as u64, newer, "it has version 99 of the format");
    check(2, "[]", "not safetensors");
    let huge = r#"{"a":{"dtype":"F32","shape":[4611686018427387904],"data_offsets":[0,0]}}"#;
    check(huge.len() as u64, huge, "not safetensors");
    let deep = "[".repeat(100_000);
    check(deep.len() as u64, &deep, "not safetensors");
}

#[test]
fn arrays_of_another_run_are_refused_with_their_names() {
    let (_root, path) = written();
    let refused = |options: Setup, words: &str| {
        let mut checkpoint = Checkpoint::open(&path).unwrap();
        let mut other = CpuBackend::new(&gaussians(ROWS), &options).unwrap();
        let problem = checkpoint.restore(&mut other).unwrap_err().to_string();
        assert!(problem.contains(words), "{problem}");
    };
    let plain = Setup { needs: Needs::default(), ..options(ROWS) };
    refused(plain, "has a tensor `signals.MeanGradientX`, which this run does not have");
    let mut more_signals = options(ROWS);
    more_signals.needs.signals = more_signals.needs.signals.with(Signal::PixelCount);
    refused(more_signals, "there is no tensor `signals.PixelCount`");
    let mut other_cadence = options(ROWS);
    other_cadence.needs.cadence = Cadence { all: 1, sh_rest: 4 };
    refused(other_cadence, "`summed.gradients`: its shape is [61, 23]; this run needs [61, 9]");
    let mut fewer_candidates = options(ROWS);
    fewer_candidates.needs.candidates =
        fewer_candidates.needs.candidates.map(|c| CandidateRequest { capacity: 3, ..c });
    refused(fewer_candidates, "`candidates`: it has 4 candidates; this run holds at most 3");
    let mut small = CpuBackend::new(&Gaussians::zeros(3, 1), &options(ROWS)).unwrap();
    let problem = Checkpoint::open(&path).unwrap().restore(&mut small).unwrap_err().to_string();
    assert!(problem.contains("`model.means`: it is F32 of shape [61, 3]"), "{problem}");
    // A model larger than its own budget, or with an invalid degree.
    for (budget, sh_degree, words) in
        [(60, 1, "61 rows, but its budget is 60"), (64, 9, "at most 3")]
    {
        let mut header = header(ROWS);
        (header.budget, header.sh_degree) = (budget, sh_degree);
        write(&path, &header, &backend(ROWS)).unwrap();
        let problem = Checkpoint::open(&path).unwrap().blank_model().unwrap_err().to_string();
        assert!(problem.contains(words), "{problem}");
    }
}

#[test]
fn the_newest_usable_checkpoint_is_found_and_two_are_kept() {
    let (root, path) = written();
    let run = root.path();
    for step in [5, 9, 100, 30] {
        std::fs::copy(&path, checkpoint_path(run, step)).unwrap();
    }
    std::fs::write(checkpoint_path(run, 100), "damaged").unwrap();
    std::fs::write(run.join("checkpoints/notes.txt"), "mine").unwrap();
    let (found, rejected) = newest(run);
    assert_eq!(found.unwrap().path(), checkpoint_path(run, 30));
    assert_eq!(rejected.len(), 1);
    assert!(rejected[0].to_string().contains("iteration_100"));
    remove_older(run, 30);
    let mut remaining: Vec<String> = std::fs::read_dir(run.join("checkpoints"))
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    remaining.sort();
    let [a, b, c] = [100, 17, 30].map(|n| format!("iteration_{n}.safetensors"));
    assert_eq!(remaining, [&a, &b, &c, "notes.txt"]);
    assert!(newest(&run.join("nowhere")).0.is_none());
}

#[test]
fn differences_of_datasets_are_named() {
    let one = header(ROWS).dataset;
    assert_eq!(one.difference(&one), None);
    let after = |change: fn(&mut Fingerprint)| {
        let mut other = one.clone();
        change(&mut other);
        one.difference(&other).unwrap()
    };
    assert_eq!(after(|f| f.train.count = 4), "3 views to train on, now 4");
    assert_eq!(after(|f| f.test.names = 0), "the names of the views held out differ");
    assert_eq!(after(|f| f.train.cameras = 0), "the cameras of the views to train on differ");
    assert_eq!(after(|f| f.train.images = 0), "the image files of the views to train on differ");
    assert!(after(|f| f.normalisation.scale = 2.0).contains("scale"));
}
