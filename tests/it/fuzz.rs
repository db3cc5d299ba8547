//! A moment of what `cargo fuzz` does without end: the files of the corpora and damaged copies of
//! them go through the readers, always the same ones.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

#[path = "../fuzz/formats.rs"]
#[expect(unreachable_pub, reason = "the fuzz targets reach it")]
mod formats;

/// Damaged copies of each file.
const COPIES: u64 = 150;

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fuzz")
}

/// The files of a format's corpus, by name.
fn corpus(format: &str) -> Vec<(String, Vec<u8>)> {
    let listing = std::fs::read_dir(folder().join("corpus").join(format)).expect("a corpus");
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

/// Draws that depend on nothing but their seed.
struct Draws(ChaCha8Rng);

impl Draws {
    /// Below `bound`, and 0 where nothing is.
    fn below(&mut self, bound: usize) -> usize {
        self.0.random_range(0..bound.max(1))
    }
}

/// Numbers that parsers stumble over.
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

/// One wound.
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
fn damaged_files_are_refused_or_read() {
    let mut failures = Vec::new();
    for (format, _) in formats::FORMATS {
        let mut accepted = 0;
        let mut copies = 0;
        for (name, file) in corpus(format) {
            for copy in 0..=COPIES {
                let mut bytes = file.clone();
                let mut draws = Draws(ChaCha8Rng::seed_from_u64(copy));
                // The first copy is whole.
                for _ in 0..copy.min(1 + copy % 4) {
                    damage(&mut bytes, &mut draws);
                }
                let outcome = catch_unwind(AssertUnwindSafe(|| formats::read(format, &bytes)));
                copies += u64::from(copy > 0);
                match outcome {
                    Ok(read) => accepted += u64::from(read && copy > 0),
                    Err(_) => {
                        let to = Path::new(env!("CARGO_TARGET_TMPDIR"));
                        let to = to.join(format!("{format}-{name}-{copy}"));
                        std::fs::write(&to, &bytes).expect("a folder for it");
                        failures.push(to);
                    }
                }
                if copy == 0 && !name.starts_with("fault") {
                    assert!(
                        formats::read(format, &bytes),
                        "{format}/{name} is not accepted as it is"
                    );
                }
            }
        }
        assert!(copies >= COPIES, "{format} has no corpus");
        // Always refused, the damage would stop at the first gate.
        assert!(accepted > 0 || format == "checkpoint", "{format}: none of {copies}");
    }
    assert!(failures.is_empty(), "these end in a panic: {failures:#?}");
}

#[test]
fn every_format_is_a_target_of_the_fuzzer() {
    let manifest = std::fs::read_to_string(folder().join("Cargo.toml")).expect("a manifest");
    for (format, _) in formats::FORMATS {
        assert!(manifest.contains(&format!("name = \"{format}\"")), "{format}");
    }
}
