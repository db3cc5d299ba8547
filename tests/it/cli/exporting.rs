//! `densify export`: the same model in another file, and what is refused.

use super::{densify, read, scratch, text, train};
use crate::photographs::Photographs;

#[test]
fn export_writes_the_model_of_a_run_or_a_file() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train(scene.path(), &run, 20, "--budget 320 --save-iterations 10 --quiet").ok();
    let saved = |iteration| read(&densify::output::model_path(&run, iteration));
    let [newest, early, again] =
        ["new/newest.ply", "early.bin", "again.PLY"].map(|name| root.path().join(name));
    let outcome = densify(&["export", text(&run), "-o", text(&newest)]).ok();
    assert!(outcome.stdout.contains("newest.ply"), "{outcome:?}");
    assert!(read(&newest) == saved(20));
    let flags = ["--iteration", "10", "--format", "ply"];
    densify(&[&["export", text(&run), "-o", text(&early)][..], &flags].concat()).ok();
    assert!(read(&early) == saved(10) && saved(10) != saved(20));
    densify(&["export", text(&early), "-o", text(&again)]).ok();
    assert!(read(&again) == saved(10));

    // Refused: nothing is written, nothing is lost.
    let nowhere = root.path().join("deep/nowhere.ply");
    let (run, early, nowhere_text) = (text(&run), text(&early), text(&nowhere));
    for (case, arguments, words) in [
        (
            "unknown format",
            &[run, "-o", nowhere_text, "--format", "plz"][..],
            &["`plz`", "`ply`"][..],
        ),
        ("no extension", &[run, "-o", "nowhere.zip"], &["nowhere.zip", "--format", "ply"]),
        ("unsaved iteration", &[run, "-o", nowhere_text, "--iteration", "7"], &["7", "10, 20"]),
        (
            "iteration of a file",
            &[early, "-o", nowhere_text, "--iteration", "10"],
            &["--iteration"],
        ),
        ("no run", &[text(root.path()), "-o", nowhere_text], &["holds no run"]),
        (
            "a model that is none",
            &[text(&scene.file("images/view_00.png")), "-o", nowhere_text],
            &["PLY"],
        ),
        ("in the way", &[run, "-o", text(&again)], &["exists", "--overwrite"]),
        ("a folder", &[run, "-o", run, "--format", "ply", "--overwrite"], &["is a folder"]),
    ] {
        densify(&[&["export"][..], arguments].concat()).refused(case, words);
    }
    assert!(
        !nowhere.parent().expect("it has one").exists() && read(&again) == read(early.as_ref())
    );
    densify(&["export", run, "-o", text(&again), "--overwrite"]).ok();
    assert!(read(&again) == read(&newest));
}
