//! A short, reproducible fuzzing run: all readers get the files of the corpora and damaged copies of them.

use std::collections::BTreeSet;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use densify_fixtures::corpus;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

#[path = "../fuzz/formats.rs"]
#[expect(unreachable_pub, reason = "the fuzz target uses it")]
mod formats;

use formats::targets;

/// Number of damaged copies of each file.
const COPIES: u64 = 150;

/// The files of a target's corpus, by name.
fn files(target: &str) -> Vec<(String, Vec<u8>)> {
    let listing = std::fs::read_dir(corpus(target))
        .unwrap_or_else(|error| panic!("tests/fuzz/corpus/{target}: {error}"));
    let mut files: Vec<_> = listing
        .map(|entry| {
            let path = entry.expect("a readable folder").path();
            let name = path.file_name().expect("a name").to_string_lossy().into_owned();
            (name, std::fs::read(&path).expect("a readable file"))
        })
        .collect();
    files.sort();
    files
}

/// A seeded random generator.
struct Draws(ChaCha8Rng);

impl Draws {
    /// A number below `bound`, or 0 if `bound` is 0.
    fn below(&mut self, bound: usize) -> usize {
        self.0.random_range(0..bound.max(1))
    }
}

/// Texts and numbers that break parsers.
const WORDS: [&[u8]; 12] = [
    b"0",
    b"-1",
    b"1e999",
    b"nan",
    b"-inf",
    b"4294967296",
    b"18446744073709551615",
    b"1e-320",
    b"\n",
    b"\"",
    b"..",
    b"[[[[[[[[",
];
const INTEGERS: [u64; 8] = [0, 1, u64::MAX, 1 << 31, (1 << 31) - 1, 1 << 32, 1 << 62, 0x7ff8 << 48];

/// Damages a file in one place.
fn damage(bytes: &mut Vec<u8>, draws: &mut Draws) {
    let at = draws.below(bytes.len());
    let end = (at + 1 + draws.below(16)).min(bytes.len());
    match draws.below(7) {
        0 => bytes.truncate(at),
        1 => drop(bytes.drain(at..end)),
        2 => {
            let twice = bytes[at..end].to_vec();
            bytes.splice(at..at, twice);
        }
        3 => {
            if let Some(byte) = bytes.get_mut(at) {
                *byte ^= 1 << draws.below(8);
            }
        }
        4 => {
            if let Some(byte) = bytes.get_mut(at) {
                *byte = draws.below(256) as u8;
            }
        }
        5 => {
            let width = [1, 2, 4, 8][draws.below(4)];
            let integer = INTEGERS[draws.below(INTEGERS.len())].to_le_bytes();
            for (byte, &new) in bytes[at..].iter_mut().zip(&integer[..width]) {
                *byte = new;
            }
        }
        _ => {
            let from = bytes[at..].iter().position(u8::is_ascii_digit).map_or(at, |i| at + i);
            let to = from + bytes[from..].iter().take_while(|b| b.is_ascii_digit()).count();
            let word = WORDS[draws.below(WORDS.len())];
            bytes.splice(from..to, word.iter().copied());
        }
    }
}

#[test]
fn damaged_files_never_cause_a_panic() {
    let mut failures = Vec::new();
    for target in targets() {
        let target_name = target.name;
        let mut accepted = 0;
        for (name, file) in files(target_name) {
            for copy in 0..=COPIES {
                let mut bytes = file.clone();
                let mut draws = Draws(ChaCha8Rng::seed_from_u64(copy));
                // The first copy is undamaged.
                for _ in 0..copy.min(1 + copy % 4) {
                    damage(&mut bytes, &mut draws);
                }
                match catch_unwind(AssertUnwindSafe(|| target.accepts(&bytes))) {
                    Ok(accepts) if copy > 0 => accepted += u64::from(accepts),
                    Ok(accepts) => {
                        let is_fault = name.starts_with("fault");
                        assert!(
                            accepts || is_fault,
                            "{target_name}/{name} is not accepted undamaged"
                        );
                    }
                    Err(_) => {
                        let to = Path::new(env!("CARGO_TARGET_TMPDIR"));
                        let to = to.join(format!("{target_name}-{name}-{copy}"));
                        std::fs::write(&to, &bytes).expect("a folder for the input");
                        failures.push(to);
                    }
                }
            }
        }
        // If every copy were refused, damage would never get past the first check.
        assert!(
            accepted > 0 || target_name == "checkpoint",
            "{target_name} accepts no damaged copy"
        );
    }
    assert!(failures.is_empty(), "these cause a panic: {failures:#?}");
}

/// This test fails for a new format until there is a corpus for it.
#[test]
fn formats_and_corpora_correspond() {
    let names: Vec<&str> = targets().iter().map(|target| target.name).collect();
    let unique: BTreeSet<String> = names.iter().map(|&name| name.to_owned()).collect();
    assert_eq!(unique.len(), names.len(), "two targets have the same name: {names:?}");
    for &name in &names {
        assert!(!files(name).is_empty(), "tests/fuzz/corpus/{name} is empty");
    }
    let folders = std::fs::read_dir(corpus(".")).expect("the corpora");
    let folders: BTreeSet<String> = folders
        .map(|entry| entry.expect("a folder").file_name().to_string_lossy().into_owned())
        .collect();
    assert_eq!(folders, unique);
}
