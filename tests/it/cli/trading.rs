//! `densify trade`: measures the effect of knobs on quality, time and memory.

use std::path::Path;

use serde_json::Value;

use super::{Outcome, call, files, read, read_text, records, scratch, text};
use crate::photographs::Photographs;

fn trade(scene: &Path, output: &Path, more: &str) -> Outcome {
    call(&format!("trade {} -o {} -b 250 -i 24 {more}", text(scene), text(output)))
}

#[test]
fn every_level_is_measured_once_and_listed() {
    let scene = Photographs::colmap_text();
    let (_root, output) = scratch();
    let knobs = "alpha_min:1/32,sh_degree:1,tile_cap,transmittance_stop:1e-3:1e-2";
    let call = format!("--knobs {knobs} --seeds 2 -- --sh-degree 0");
    let stdout = trade(scene.path(), &output, &call).ok().stdout;
    assert!(stdout.contains("[16/16]") && stdout.contains("alpha_min=1/32"), "{stdout}");
    let all = records(&output.join("trade.jsonl"));
    let find = |knob: &str, level: &str, seed: u64| {
        let matches = |r: &&Value| r["factor"] == knob && r["level"] == level && r["seed"] == seed;
        all.iter().find(matches).unwrap_or_else(|| panic!("{knob}={level}, {seed}: {all:?}"))
    };
    for seed in 0..2 {
        let base = find("", "", seed);
        assert!(
            base["psnr"].as_f64() > Some(5.0) && base["ssim"].is_f64() && base["flip"].is_f64()
        );
        assert!(base["seconds"].as_f64() > Some(0.0) && base["ledger_bytes"].is_u64(), "{base}");
        // Only exact knobs leave the model unchanged.
        assert_eq!(find("tile_cap", "250", seed)["model"], base["model"]);
        assert_ne!(find("alpha_min", "1/32", seed)["model"], base["model"]);
        assert_ne!(find("sh_degree", "1", seed)["model"], base["model"]);
    }
    assert_ne!(find("", "", 0)["model"], find("", "", 1)["model"], "the seeds have no effect");
    // All other settings are those of the preset `exact`.
    let spec = |knob: &str, level: &str| find(knob, level, 0)["spec"].clone();
    assert_eq!(spec("", "")["preset"], "exact");
    let changed = spec("alpha_min", "1/32");
    assert_eq!(
        (&changed["preset"], &changed["knob"]["alpha_min"]),
        (&"exact".into(), &"1/32".into())
    );
    let table = read_text(&output.join("trade.md"));
    for words in ["--sh-degree 0", "2 of 2", "pareto-"] {
        assert!(table.contains(words), "{words} is not in {table}");
    }
    let picture = table.split("](").nth(1).and_then(|rest| rest.split(')').next());
    let picture = read(&output.join(picture.expect("a plot")));
    assert!(picture.starts_with(b"<svg"));
    let page = read_text(&output.join("trade.html"));
    super::reporting::assert_self_contained(&page);
    assert!(page.contains("<td>alpha_min</td>") && page.contains("src=\"data:image/svg+xml"));

    // Repeating the call trains nothing and changes no file.
    let before = files(&output);
    let stdout = trade(scene.path(), &output, &call).ok().stdout;
    assert_eq!(stdout.matches("done before").count(), 16, "{stdout}");
    assert!(before == files(&output), "a complete study was changed");
}

#[test]
fn invalid_studies_are_refused_before_any_run() {
    let scene = Photographs::colmap_text();
    let (_root, output) = scratch();
    for (more, words) in [
        ("--knobs alpha_mim", ["alpha_mim", "alpha_min"]),
        ("--knobs alpha_min:1/2", ["alpha_min", "1/32"]),
        ("--knobs alpha_min,alpha_min", ["alpha_min", "twice"]),
        ("--knobs near", ["near", "VALUE"]),
        ("--knobs near:2", ["near", "less than 1"]),
        ("-- --knob alpha_min=1/64", ["--knob", "study"]),
        ("-- --seed 3", ["--seed", "study"]),
    ] {
        trade(scene.path(), &output, more).refused(more, &words);
        assert!(!output.exists(), "{more}: the output exists");
    }
}
