//! `densify export`: the same model in another file, and what is refused.

use std::path::Path;

use super::{call, read, scratch, text, train};
use crate::photographs::Photographs;

#[test]
fn export_writes_the_model_of_a_run_or_a_file() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train(scene.path(), &run, 20, "--budget 320 --save-iterations 10 --quiet").ok();
    let saved = |iteration| read(&densify::output::model_path(&run, iteration));
    let [newest, early, again] =
        ["new/newest.ply", "early.bin", "again.PLY"].map(|name| root.path().join(name));
    let export = |from: &Path, to: &Path, flags: &str| {
        call(&format!("export {} -o {} {flags}", text(from), text(to)))
    };
    let outcome = export(&run, &newest, "").ok();
    assert!(outcome.stdout.contains("newest.ply"), "{outcome:?}");
    assert!(read(&newest) == saved(20));
    export(&run, &early, "--iteration 10 --format ply").ok();
    assert!(read(&early) == saved(10) && saved(10) != saved(20));
    export(&early, &again, "").ok();
    assert!(read(&again) == saved(10));

    // Refused: nothing is written, nothing is lost.
    let nowhere = root.path().join("deep/nowhere.ply");
    let (zip, picture) = (root.path().join("nowhere.zip"), scene.file("images/view_00.png"));
    let cases: [(&Path, &Path, &str, &[&str]); 8] = [
        (&run, &nowhere, "--format plz", &["`plz`", "`ply`"]),
        (&run, &zip, "", &["nowhere.zip", "--format", "ply"]),
        (&run, &nowhere, "--iteration 7", &["7", "10, 20"]),
        (&early, &nowhere, "--iteration 10", &["--iteration"]),
        (root.path(), &nowhere, "", &["holds no run"]),
        (&picture, &nowhere, "", &["PLY"]),
        (&run, &again, "", &["exists", "--overwrite"]),
        (&run, &run, "--format ply --overwrite", &["is a folder"]),
    ];
    for (from, to, flags, words) in cases {
        export(from, to, flags).refused(&format!("{from:?} to {to:?}"), words);
    }
    assert!(!root.path().join("deep").exists() && !zip.exists() && read(&again) == read(&early));
    export(&run, &again, "--overwrite").ok();
    assert!(read(&again) == read(&newest));
}
