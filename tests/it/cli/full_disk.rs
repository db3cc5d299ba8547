//! A full disk while a model is written: exit code 1, one message with the remedy, and no partial file.

use assert_cmd::Command;
use densify::data::models::export_formats;
use densify::train::output::model_path;

use super::{Outcome, files, outcome_of, read, scratch, text, train};
use crate::photographs::Photographs;

/// Calls the program with a file size limit of 2 or 4 KB, depending on the shell's unit. To a writer this looks like a
/// full disk.
fn call_on_full_disk(words: &str) -> Outcome {
    let program = env!("CARGO_BIN_EXE_densify");
    let mut command = Command::new("sh");
    // SIGXFSZ is ignored, because a full disk raises no signal.
    command.args(["-c", &format!("trap '' XFSZ; ulimit -f 4; exec {program} {words}")]);
    command.env_remove("RUST_LOG").env("NODEVICE_SELECT", "1");
    outcome_of(command)
}

/// Checks exit code and message of a call that ran out of disk space.
fn assert_disk_full(outcome: &Outcome, case: &str, file: &str) {
    let Outcome { code, stderr, .. } = outcome;
    assert_eq!(*code, Some(1), "{case}: {outcome:?}");
    assert_eq!(stderr.matches("error:").count(), 1, "{case}: {stderr}");
    for word in ["cannot write", file, "make room"] {
        assert!(stderr.contains(word), "{case}: {word:?} is not in: {stderr}");
    }
    assert!(!stderr.contains("panicked"), "{case}: {stderr}");
}

#[test]
fn a_full_disk_leaves_no_partial_file_in_any_format() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train(scene.path(), &run, 20, "--budget 320 --quiet").ok();
    let before = files(root.path());
    for format in export_formats() {
        let name = format!("full.{}", format.extension);
        let to = root.path().join(&name);
        let words = format!("export {} -o {} --format {}", text(&run), text(&to), format.name);
        assert_disk_full(&call_on_full_disk(&words), format.name, &name);
        assert!(files(root.path()) == before, "{}: something is left", format.name);
        // An existing file stays intact.
        std::fs::write(&to, "old").unwrap();
        assert_disk_full(&call_on_full_disk(&format!("{words} --overwrite")), format.name, &name);
        assert_eq!(read(&to), b"old", "{}", format.name);
        std::fs::remove_file(&to).unwrap();
    }
    // `compress` first writes a temporary file to measure the result.
    let to = root.path().join("small.spz");
    let model = model_path(&run, 20);
    let words = format!(
        "compress {} --to 1MiB -o {} --scene {} --backend cpu",
        text(&model),
        text(&to),
        text(scene.path())
    );
    assert_disk_full(&call_on_full_disk(&words), "compress", ".densify-");
    assert!(files(root.path()) == before, "compress: something is left");
}
