//! `densify export`: models in other formats, and refused calls.

use std::path::Path;

use super::{call, files, gaussians, read, scratch, text, train, write_ply};
use crate::photographs::Photographs;

#[test]
fn export_reads_runs_and_files() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train(scene.path(), &run, 20, "--budget 320 --save-iterations 10 --quiet").ok();
    let saved = |iteration| read(&densify::train::output::model_path(&run, iteration));
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

    // Refused calls write nothing and replace nothing.
    let nowhere = root.path().join("deep/nowhere.ply");
    let (zip, picture) = (root.path().join("nowhere.zip"), scene.file("images/view_00.png"));
    let cases: [(&Path, &Path, &str, &[&str]); 11] = [
        (&run, &nowhere, "--format plz", &["`plz`", "`ply`"]),
        (&run, &zip, "", &["nowhere.zip", "--format", "ply"]),
        (&run, &nowhere, "--iteration 7", &["7", "10, 20"]),
        (&early, &nowhere, "--iteration 10", &["--iteration"]),
        (root.path(), &nowhere, "", &["holds no run"]),
        (Path::new("absent.ply"), &nowhere, "", &["absent.ply does not exist"]),
        (&run, Path::new("/dev/null"), "--format ply --overwrite", &["/dev/null", "device"]),
        (&run, &early, "--format all --overwrite", &["early.bin", "name a folder"]),
        (&picture, &nowhere, "", &["ply", "convert it"]),
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

#[test]
fn every_format_is_written_compared_and_read_back() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train(scene.path(), &run, 20, "--budget 320 --eval --quiet").ok();
    let folder = root.path().join("all");
    let flags = format!("--format all --scene {} --backend cpu", text(scene.path()));
    let call_all = || call(&format!("export {} -o {} {flags}", text(&run), text(&folder)));
    let outcome = call_all().ok();
    let line = |name: &str| {
        let found = outcome.stdout.lines().find(|line| line.starts_with(&format!("{name} ")));
        found.unwrap_or_else(|| panic!("no line for {name}: {outcome:?}")).to_owned()
    };
    assert!(line("ply").ends_with("same") && line("glb").ends_with("same"), "{outcome:?}");
    // The lowest accepted PSNR [dB] for trained scenes; this one has hardly been trained.
    for (name, floor) in [("compressed-ply", 45.0), ("spz", 45.0), ("spz-v4", 45.0), ("sog", 42.0)]
    {
        let psnr: f64 = line(name).split_whitespace().last().unwrap().parse().unwrap();
        assert!(psnr > floor, "{}", line(name));
    }
    let saved = read(&densify::train::output::model_path(&run, 20));
    let name = run.file_name().unwrap().to_str().unwrap();
    let at = |ending: &str| folder.join(format!("{name}.{ending}"));
    assert!(read(&at("ply")) == saved);
    let again = root.path().join("again.ply");
    for ending in ["glb", "spz", "sog", "compressed.ply"] {
        call(&format!("export {} -o {} --overwrite", text(&at(ending)), text(&again))).ok();
        assert_eq!(read(&again).len(), saved.len(), "{ending}");
        // A truncated file is refused with a message that names it, and nothing is written.
        let whole = read(&at(ending));
        let (cut, lost) = (root.path().join("cut"), root.path().join("lost.ply"));
        std::fs::write(&cut, &whole[..whole.len() / 2]).unwrap();
        let refused = call(&format!("export {} -o {}", text(&cut), text(&lost)));
        refused.refused(ending, &["cut", "export the file again"]);
        assert!(!lost.exists());
    }
    call_all().refused("again", &["exists", "--overwrite"]);
    // A format that cannot represent the model is named, and the others are written.
    let (remote, others) = (root.path().join("re.mote.ply"), root.path().join("others"));
    let mut model = gaussians(&at("ply"));
    model.means[0][1] = 1e9;
    write_ply(&model, &remote);
    let outcome = call(&format!("export {} -o {} --format all", text(&remote), text(&others))).ok();
    assert!(outcome.stdout.contains("not written") && outcome.stdout.contains("of the PLY"));
    let names: Vec<_> = files(&others).into_keys().collect();
    let expected = ["glb", "ply", "sog"].map(|extension| format!("re.mote.{extension}"));
    assert!(expected.iter().all(|name| names.contains(name)), "{names:?}");
    // SPZ cannot represent the position. In the compressed PLY, the other Gaussians of the same chunk would collapse to
    // a plane.
    let unfit = |name: &String| name.ends_with("spz") || name.contains("compressed");
    assert!(!names.iter().any(unfit), "{names:?}");
    let refused =
        call(&format!("export {} -o {}", text(&remote), text(&root.path().join("x.spz"))));
    refused.refused("remote", &["x.spz", "no room", "choose another format"]);
    let near = format!("export {} -o {} --near 0.1", text(&run), text(&again));
    call(&near).refused("near", &["--near", "a run brings its own"]);
}

/// SPZ clamps scales. A model scaled down to a ten-thousandth is therefore not written as SPZ, and the format that the
/// message proposes instead can represent it.
#[test]
fn a_model_beyond_the_range_of_a_format_is_refused() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train(scene.path(), &run, 20, "--budget 320 --quiet").ok();
    let [model, to] = ["tiny.ply", "tiny.spz"].map(|name| root.path().join(name));
    let mut tiny = gaussians(&densify::train::output::model_path(&run, 20));
    tiny.means.as_flattened_mut().iter_mut().for_each(|value| *value *= 1e-4);
    tiny.log_scales.as_flattened_mut().iter_mut().for_each(|log| *log += 1e-4_f32.ln());
    write_ply(&tiny, &model);
    std::fs::write(&to, "old").unwrap();
    let export = |to: &Path| call(&format!("export {} -o {} --overwrite", text(&model), text(to)));
    let refused = export(&to);
    refused.refused("spz", &["tiny.spz", "the scales of", "% of the visible area", "such as"]);
    assert_eq!(read(&to), b"old");
    let other = refused.stderr.trim().rsplit(' ').next().unwrap();
    let outcome = export(&root.path().join(format!("tiny.{}", other.replace('-', ".")))).ok();
    assert!(!outcome.stdout.contains("visible area"), "{outcome:?}");
}
