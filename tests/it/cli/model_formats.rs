//! Model files of every format, recognised by content, in `eval`, `render`, `export` and `--init`.

use std::path::{Path, PathBuf};

use densify::core::gaussians::{Gaussians, sigmoid};
use densify::train::output::model_path;

use super::{call, count, gaussians, json, read, scratch, text, train};
use crate::photographs::Photographs;

/// Encodes a model as `.splat`: positions and scales as f32; colour, opacity and quaternion as bytes; without
/// view-dependent colour.
fn as_splat(model: &Gaussians) -> Vec<u8> {
    let byte = |value: f32| value.round().clamp(0.0, 255.0) as u8;
    let row = |row: usize| {
        let mut bytes = Vec::new();
        let scales = model.log_scales[row].map(f32::exp);
        for value in model.means[row].iter().chain(&scales) {
            bytes.extend(value.to_le_bytes());
        }
        let colour = [0, 1, 2].map(|i| 0.5 + 0.282_094_8 * model.sh_of(row)[i]);
        bytes.extend(colour.map(|value| byte(255.0 * value)));
        bytes.push(byte(255.0 * sigmoid(model.opacity_logits[row])));
        bytes.extend(model.quats[row].map(|value| byte(128.0 * value + 128.0)));
        bytes
    };
    (0..model.len()).flat_map(row).collect()
}

/// Unpacks an uncompressed ZIP archive.
fn unpack(archive: &[u8], to: &Path) {
    std::fs::create_dir_all(to).unwrap();
    let word = |at: usize, n: usize| {
        archive[at..at + n].iter().rev().fold(0, |word, &byte| word << 8 | usize::from(byte))
    };
    let mut at = 0;
    while archive[at..].starts_with(b"PK\x03\x04") {
        let (size, name) = (word(at + 18, 4), word(at + 26, 2));
        let data = at + 30 + name + word(at + 28, 2);
        let name = std::str::from_utf8(&archive[at + 30..at + 30 + name]).unwrap();
        std::fs::write(to.join(name), &archive[data..data + size]).unwrap();
        at = data + size;
    }
}

/// The mean PSNR that `eval` prints [dB].
fn mean(stdout: &str) -> f64 {
    let line = stdout.lines().find(|line| line.starts_with("mean")).expect("a mean");
    line.split_whitespace().nth(1).unwrap().parse().unwrap()
}

#[test]
fn every_command_accepts_models_of_any_format() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train(scene.path(), &run, 60, "--budget 320 --eval --quiet").ok();
    let psnr = json(&run.join("results.json"))["ours_60"]["PSNR"].as_f64().unwrap();
    let whole = gaussians(&model_path(&run, 60));
    let at = |name: &str| root.path().join(name);
    // File names without extensions, so that only the content identifies the format.
    let mut models: Vec<(&str, PathBuf)> = Vec::new();
    for format in ["ply", "glb", "sog", "compressed-ply", "spz", "spz-v4"] {
        let file = at(&format!("model-{format}"));
        call(&format!("export {} -o {} --format {format}", text(&run), text(&file))).ok();
        models.push((format, file));
    }
    unpack(&read(&at("model-sog")), &at("folder"));
    models.push(("sog folder", at("folder")));
    std::fs::write(at("model-splat"), as_splat(&whole)).unwrap();
    models.push((".splat", at("model-splat")));
    for (format, file) in &models {
        let (file, dataset) = (text(file), text(scene.path()));
        let before = super::files(root.path()).len();
        let stdout = call(&format!("eval {file} --scene {dataset} --backend cpu")).ok().stdout;
        assert_eq!(super::files(root.path()).len(), before, "{format}: eval of a file wrote files");
        // `.splat` loses view-dependent colour. The other formats reproduce the model's images at 42 dB or more, better
        // than the model does the photographs.
        let tolerance = if *format == ".splat" { 3.0 } else { 0.1 };
        assert!((mean(&stdout) - psnr).abs() < tolerance, "{format}: {} of {psnr}", mean(&stdout));

        let pictures = at("pictures");
        let render =
            format!("render {file} --scene {dataset} --eval -o {} --backend cpu", text(&pictures));
        call(&render).ok();
        assert_eq!(std::fs::read_dir(&pictures).unwrap().count(), 2, "{format}");
        std::fs::remove_dir_all(&pictures).unwrap();

        let again = at("again.ply");
        call(&format!("export {file} -o {}", text(&again))).ok();
        assert_eq!(gaussians(&again).len(), whole.len(), "{format}");
        std::fs::remove_file(&again).unwrap();

        let from = at("from");
        let flags = format!("--init {file} --budget 400 --eval --quiet --backend cpu");
        train(scene.path(), &from, 1, &flags).ok();
        let summary = json(&from.join("stats/summary.json"));
        assert!(count(&summary, "peak_rows") >= whole.len() as u64, "{format}: {summary}");
        let after = json(&from.join("results.json"))["ours_1"]["PSNR"].as_f64().unwrap();
        assert!(
            (after - psnr).abs() < tolerance + 1.0,
            "{format}: {after} after a step, {psnr} before"
        );
        std::fs::remove_dir_all(&from).unwrap();
    }

    // Required and rejected options for model files.
    let file = text(&models[0].1).to_owned();
    call(&format!("eval {file}")).refused("no dataset", &["which has no cameras", "--scene"]);
    let iteration = format!("eval {file} --scene {} --iteration 60", text(scene.path()));
    call(&iteration).refused("iteration", &["--iteration", "only one model"]);
    let near = format!("eval {} --near 0.1", text(&run));
    call(&near).refused("near", &["--near", "a run brings its own"]);
    let limit = format!("eval {file} --scene {} --fail-below psnr=90", text(scene.path()));
    assert_eq!(call(&limit).code, Some(4));
}
