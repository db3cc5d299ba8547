//! A disk that fills while a model is written: exit code 1, one message with the remedy, and nothing of the file.

use assert_cmd::Command;
use densify::data::models::export_formats;
use densify::train::output::model_path;

use super::{Outcome, files, outcome_of, read, scratch, text, train};
use crate::photographs::Photographs;

/// Calls the program where no file may have more than two or four kilobytes, which is what a shell's unit makes of it:
/// to a writer that is as a disk that is full.
fn call_where_it_fills(words: &str) -> Outcome {
    let program = env!("CARGO_BIN_EXE_densify");
    let mut command = Command::new("sh");
    // The signal that tells of it is ignored, as the system has none for a full disk.
    command.args(["-c", &format!("trap '' XFSZ; ulimit -f 4; exec {program} {words}")]);
    command.env_remove("RUST_LOG").env("NODEVICE_SELECT", "1");
    outcome_of(command)
}

/// Fails unless the call ended as one must for which there was no room.
fn ran_full(outcome: &Outcome, case: &str, file: &str) {
    let Outcome { code, stderr, .. } = outcome;
    assert_eq!(*code, Some(1), "{case}: {outcome:?}");
    assert_eq!(stderr.matches("error:").count(), 1, "{case}: {stderr}");
    for word in ["cannot write", file, "make room"] {
        assert!(stderr.contains(word), "{case}: {word:?} is not in: {stderr}");
    }
    assert!(!stderr.contains("panicked"), "{case}: {stderr}");
}

#[test]
fn nothing_is_left_in_any_format() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train(scene.path(), &run, 20, "--budget 320 --quiet").ok();
    let before = files(root.path());
    for format in export_formats() {
        let name = format!("full.{}", format.extension);
        let to = root.path().join(&name);
        let words = format!("export {} -o {} --format {}", text(&run), text(&to), format.name);
        ran_full(&call_where_it_fills(&words), format.name, &name);
        assert!(files(root.path()) == before, "{}: something is left", format.name);
        // What was there before stays.
        std::fs::write(&to, "old").unwrap();
        ran_full(&call_where_it_fills(&format!("{words} --overwrite")), format.name, &name);
        assert_eq!(read(&to), b"old", "{}", format.name);
        std::fs::remove_file(&to).unwrap();
    }
    // What is compressed is first written to look at it again.
    let to = root.path().join("small.spz");
    let model = model_path(&run, 20);
    let words = format!(
        "compress {} --to 1MiB -o {} --scene {} --backend cpu",
        text(&model),
        text(&to),
        text(scene.path())
    );
    ran_full(&call_where_it_fills(&words), "compress", ".densify-");
    assert!(files(root.path()) == before, "compress: something is left");
}
