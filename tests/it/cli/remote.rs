//! Scenes in coordinates too large for f32, as in UTM: saved models keep their quality, or a note says otherwise.

#![allow(clippy::float_cmp, reason = "results are exact")]

use std::path::Path;

use densify::data::models::{find, sidecar_path};
use densify::train::checkpoint::checkpoint_path;
use densify::train::output::model_path;
use glam::DVec3;

use super::{call, gaussians, json, read, scratch, text, train, write_ply};
use crate::photographs::Photographs;

/// Easting, northing and height `[m]`. At this northing, f32 resolves 0.5 m; Gaussians measure 0.1 m to 0.4 m.
const UTM: DVec3 = DVec3::new(512_345.25, 5_400_123.25, 81.0);
const ITERATIONS: u32 = 60;

/// The PSNR of a run after its last iteration `[dB]`.
fn psnr(run: &Path, iterations: u32) -> f64 {
    json(&run.join("results.json"))[format!("ours_{iterations}")]["PSNR"].as_f64().unwrap()
}

/// The mean PSNR that `eval` prints for a file `[dB]`.
fn evaluated(file: &Path, scene: &Photographs) -> f64 {
    let words = format!("eval {} --scene {} --backend cpu", text(file), text(scene.path()));
    let stdout = call(&words).ok().stdout;
    let line = stdout.lines().find(|line| line.starts_with("mean")).expect("a mean");
    line.split_whitespace().nth(1).unwrap().parse().unwrap()
}

fn head(file: &Path) -> String {
    String::from_utf8_lossy(&read(file)[..200]).into_owned()
}

/// The means in a run's last checkpoint.
fn means_in_checkpoint(run: &Path) -> Vec<u8> {
    let bytes = read(&checkpoint_path(run, ITERATIONS));
    let length = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    let header: serde_json::Value = serde_json::from_slice(&bytes[8..8 + length]).unwrap();
    let at = |i: usize| header["model.means"]["data_offsets"][i].as_u64().unwrap() as usize;
    bytes[8 + length + at(0)..8 + length + at(1)].to_vec()
}

#[test]
fn a_model_far_from_the_origin_keeps_its_quality_or_is_noted() {
    let (scene, far) = (Photographs::colmap_text(), Photographs::colmap_text_at(UTM));
    let root = tempfile::tempdir().unwrap();
    let run = |name: &str, scene: &Photographs, flags: &str| {
        let folder = root.path().join(name);
        let flags = format!("--budget 320 --eval {flags}");
        let outcome = train(scene.path(), &folder, ITERATIONS, &flags).ok();
        (model_path(&folder, ITERATIONS), psnr(&folder, ITERATIONS), outcome.stdout)
    };
    let (file, near, stdout) = run("near", &scene, "");
    assert!(!stdout.contains("coords") && !stdout.contains("so far from the origin"), "{stdout}");
    assert!(!head(&file).contains("comment"));
    let mut files = Vec::new();
    for (name, flags) in
        [("auto", ""), ("local", "--coordinates local"), ("double", "--coordinates double")]
    {
        let (file, found, stdout) = run(name, &far, flags);
        assert!((found - near).abs() < 0.05, "{name}: {found} of {near}");
        let saved = evaluated(&file, &far);
        assert!((saved - near).abs() < 0.05, "{name}: {saved} of {near}");
        let is_noted = stdout.contains("coords   local") && stdout.contains("note: saved in local");
        assert_eq!(is_noted, name == "auto", "{name}: {stdout}");
        files.push(file);
    }
    let [automatic, local, double] = &files[..] else { panic!("three") };
    assert!(read(automatic) == read(local));
    assert!(
        head(local).contains("\ncomment densify offset 512345 5400123 81\n"),
        "{}",
        head(local)
    );
    assert!(head(double).contains("property double x"), "{}", head(double));

    // World coordinates lose quality: a note says so before training, and scores show it. Training itself is the same.
    let flags = "--coordinates world --test-iterations 30";
    let (file, found, stdout) = run("world", &far, flags);
    assert!(found < near - 1.0, "{found} of {near}");
    let saved = evaluated(&file, &far);
    assert!((saved - found).abs() < 0.05, "{saved} of {found}");
    assert!(stdout.contains("will be worse") && stdout.contains("--coordinates local"), "{stdout}");
    let [world, local] = ["world", "local"].map(|name| root.path().join(name));
    assert!(means_in_checkpoint(&world) == means_in_checkpoint(&local));
    let plan =
        |flags: &str| call(&format!("plan {} --budget 320 {flags}", text(far.path()))).ok().stdout;
    assert!(plan("").contains("coords   local, from the offset 512345 5400123 81"), "{}", plan(""));
    assert!(plan("--coordinates world").contains("will be worse"));
    assert!(!plan("--coordinates double").contains("so far from the origin"));

    every_command_reads_local_models(&local, &far, near);
}

fn every_command_reads_local_models(run: &Path, far: &Photographs, near: f64) {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    let whole = gaussians(&model_path(run, ITERATIONS));
    let export = |from: &Path, to: &Path, flags: &str| {
        call(&format!("export {} -o {} --overwrite {flags}", text(from), text(to)))
    };
    for format in ["ply", "glb", "compressed-ply", "spz", "spz-v4", "sog"] {
        let file = at(&format!("model.{}", find(format).unwrap().extension));
        let stdout = export(run, &file, "").ok().stdout;
        assert!(stdout.contains("saved in local coordinates"), "{format}: {stdout}");
        let needs_sidecar = ["spz", "spz-v4"].contains(&format);
        assert_eq!(sidecar_path(&file).is_file(), needs_sidecar);
        assert_eq!(stdout.contains("keep both files together"), needs_sidecar, "{stdout}");
        let found = evaluated(&file, far);
        assert!((found - near).abs() < 0.1, "{format}: {found} of {near}");
        // World coordinates would not hold the model.
        let refused = export(run, &file, "--coordinates world");
        refused.refused(format, &["so far from the origin", "--coordinates local"]);
        let again = at("again.ply");
        export(&file, &again, "").ok();
        assert_eq!(gaussians(&again).origin, whole.origin, "{format}");
        if ["ply", "glb"].contains(&format) {
            assert_eq!(gaussians(&again), whole, "{format}");
            export(&file, &again, "--coordinates double").ok();
            assert!(head(&again).contains("property double y"));
            let double = gaussians(&again);
            let [a, b] = [&double, &whole].map(|model| {
                (0..whole.len()).map(|row| DVec3::from(model.position(row))).collect::<Vec<_>>()
            });
            assert!(a.iter().zip(&b).all(|(a, b)| (*a - *b).length() < 1e-8));
        }
        let from = at("from");
        let flags = format!("--init {} --budget 400 --eval --quiet --backend cpu", text(&file));
        train(far.path(), &from, 1, &flags).ok();
        let found = psnr(&from, 1);
        assert!((found - near).abs() < 1.0, "{format}: {found} after a step, {near} before");
        std::fs::remove_dir_all(&from).unwrap();
    }
    export(run, &at("model.spz"), "--coordinates double")
        .refused("spz", &["only ply", "model.spz"]);
    let (file, scene, to) = (at("model.sog"), text(far.path()), at("pictures"));
    let (file, pictures) = (text(&file), text(&to));
    call(&format!("render {file} --scene {scene} --eval -o {pictures} --backend cpu")).ok();
    assert_eq!(std::fs::read_dir(&to).unwrap().count(), 2);
    let frozen = at("frozen");
    let flags = format!("--freeze {file} --budget 400 --eval --quiet --backend cpu");
    train(far.path(), &frozen, 1, &flags).ok();
    let kept = gaussians(&model_path(&frozen, 1));
    assert!(kept.len() >= whole.len() && kept.origin == whole.origin);
    let small = at("small.spz");
    let (model, to) = (text(run), text(&small));
    call(&format!("compress {model} --to 100 -o {to} --iterations 20 --backend cpu")).ok();
    assert_eq!(gaussians(&small).origin, whole.origin);
    let found = evaluated(&small, far);
    assert!(found > 0.7 * near, "{found} of {near}");
    // A model near the origin stays as it is.
    let usual = densify::core::gaussians::Gaussians { origin: [0.0; 3], ..whole };
    write_ply(&usual, &at("usual.ply"));
    let stdout = export(&at("usual.ply"), &at("same.ply"), "").ok().stdout;
    assert!(read(&at("usual.ply")) == read(&at("same.ply")));
    assert!(!stdout.contains("so far"), "{stdout}");
}

/// A sidecar whose model was replaced is refused by every command.
#[test]
fn a_sidecar_of_another_file_is_refused() {
    let far = Photographs::colmap_text_at(UTM);
    let (root, run) = scratch();
    train(far.path(), &run, 20, "--budget 320 --quiet").ok();
    let file = root.path().join("model.spz");
    call(&format!("export {} -o {}", text(&run), text(&file))).ok();
    std::fs::write(sidecar_path(&file), "{\"offset\": [0, 0, 0], \"bytes\": 1}").unwrap();
    let to = root.path().join("again");
    let (scene, model, to) = (text(far.path()), text(&file), text(&to));
    for words in [
        format!("eval {model} --scene {scene} --backend cpu"),
        format!("export {model} -o {to}.ply"),
        format!("train {scene} -o {to} -i 1 --init {model}"),
        format!("render {model} --scene {scene} -o {to} --backend cpu"),
        format!("compress {model} --scene {scene} --to 50 -o {to}.spz --backend cpu"),
    ] {
        call(&words).refused(&words, &["model.spz.offset.json", "bytes"]);
    }
}
