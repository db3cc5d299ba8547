//! `densify compress`: files within the requested size, and refused calls.

use densify::train::output::model_path;

use super::{call, files, gaussians, read, scratch, text, train};
use crate::photographs::Photographs;

#[test]
fn compressed_files_stay_within_the_requested_size() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train(scene.path(), &run, 100, "--budget 300 --eval --quiet").ok();
    let whole = read(&model_path(&run, 100)).len();
    let rows = gaussians(&model_path(&run, 100)).len();
    let compress = |to: &str, name: &str, flags: &str| {
        let output = root.path().join(name);
        let words = format!(
            "compress {} --to {to} -o {} --iterations 30 --backend cpu {flags}",
            text(&run),
            text(&output)
        );
        (call(&words), output)
    };
    // Half of the bytes in the same format are reached by fewer Gaussians or a lower SH degree.
    let (outcome, ply) = compress(&format!("{}B", whole / 2), "half.ply", "");
    let outcome = outcome.ok();
    let size = read(&ply).len();
    assert!(size <= whole / 2 && size > whole / 4, "{size} of {whole}");
    let written: Vec<_> = outcome.stdout.lines().filter(|l| l.starts_with("written ")).collect();
    assert_eq!(written.len(), 1, "{outcome:?}");
    assert!(outcome.stdout.contains("tried "), "no other degree was tried: {outcome:?}");
    // The same call gives a byte-identical file.
    let (outcome, again) = compress(&format!("{}B", whole / 2), "again.ply", "--threads 1");
    outcome.ok();
    assert!(read(&again) == read(&ply));
    // The size can also be a number of Gaussians.
    let third = rows / 3;
    let (outcome, few) = compress(&third.to_string(), "few.ply", "");
    assert!(outcome.ok().stdout.contains(&format!("training {third} Gaussians")));
    assert_eq!(gaussians(&few).len(), third);
    // A model that is already small enough is neither trained nor reduced.
    let (outcome, same) = compress("1MiB", "same.ply", "");
    assert!(!outcome.ok().stdout.contains("training"));
    assert_eq!(read(&same).len(), whole);

    // `any` picks a format in which the whole model takes at most half the bytes of the PLY, so nothing is trained.
    let (outcome, any) = compress(&format!("{}B", whole / 2), "any", "--format any");
    let outcome = outcome.ok();
    let found: Vec<_> =
        files(root.path()).into_keys().filter(|name| name.starts_with("any.")).collect();
    let [name] = &found[..] else { panic!("{found:?}: {outcome:?}") };
    assert!(outcome.stdout.contains(name) && !outcome.stdout.contains("training"), "{outcome:?}");
    assert_eq!(gaussians(&root.path().join(name)).len(), rows);
    assert!(!any.exists() && read(&root.path().join(name)).len() <= whole / 2);

    let before = files(root.path()).len();
    for (to, name, flags, words) in [
        ("100B", "tiny.ply", "", &["--to", "no model fits"][..]),
        ("1M", "tiny.ply", "", &["--to 1000000", "has only"]),
        ("much", "tiny.ply", "", &["much", "5MiB"]),
        ("1MiB", "tiny.doc", "", &["-o", "tiny.doc"]),
        ("1MiB", "same.ply", "", &["exists", "--overwrite"]),
        ("1MiB", "any", "--format any", &["any.", "exists", "--overwrite"]),
        ("1MiB", "tiny.ply", "--format all", &["`all`", "any"]),
        ("1MiB", "tiny.ply", "--near 0.1", &["--near", "leave the option out"]),
    ] {
        let (outcome, _) = compress(to, name, flags);
        outcome.refused(name, words);
    }
    let alone = text(&ply).to_owned();
    let outcome =
        call(&format!("compress {alone} --to 50 -o {}", text(&root.path().join("x.ply"))));
    outcome.refused("a file alone", &["--scene"]);
    assert_eq!(files(root.path()).len(), before, "something is left behind");
}
