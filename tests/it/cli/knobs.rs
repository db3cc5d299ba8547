//! Knobs and presets, from the command line to the bytes of a run and back.

use std::path::Path;

use densify::knobs::{Class, How, KNOBS, Levels, On, PRESETS};

use super::{Outcome, densify, files, model, read, scratch, text, train};
use crate::photographs::Photographs;

const ITERATIONS: u32 = 24;

/// Knobs that are none of `train`'s options, each not as it is by default.
const CHANGED: &str = "--knob alpha_min=1/64 --knob transmittance_stop=1e-3 --knob ssim_every=5 \
                       --knob coarse_until=0.8 --knob param_storage=f16 \
                       --knob moment_storage=both8 --knob pairs_per_row=2";

fn short(scene: &Path, output: &Path, flags: &str) -> Outcome {
    train(scene, output, ITERATIONS, &format!("--budget 250 --test-every 3 {flags}"))
}

#[test]
fn every_knob_and_preset_is_listed() {
    let said = densify(&["knobs"]).ok().stdout;
    for knob in KNOBS {
        assert!(said.contains(&format!("  {} ", knob.name)), "{} is not in {said}", knob.name);
        assert!(said.contains(knob.what), "{} is not explained", knob.name);
    }
    for preset in PRESETS {
        assert!(said.contains(&format!("  {}: {}", preset.name, preset.what)), "{said}");
    }
}

#[test]
fn what_cannot_be_is_refused_before_anything_is_written() {
    let scene = Photographs::colmap_text();
    let (_root, output) = scratch();
    let cases: [(&str, &[&str]); 16] = [
        ("--knob alpha_min=0.5", &["alpha_min", "0.5", "1/32"]),
        ("--knob alpha_mim=1/64", &["alpha_mim", "alpha_min", "densify knobs"]),
        ("--knob alpha_min", &["--knob", "NAME=VALUE"]),
        ("--knob ssim_every=3", &["ssim_every", "1|2|5|10"]),
        ("--knob alpha_min=1/64 --knob alpha_min=1/32", &["1/64", "1/32", "contradict"]),
        // `train` gives --sh-degree 1.
        ("--knob sh_degree=2", &["--knob sh_degree=2", "--sh-degree 1", "contradict"]),
        ("--sh-every 4 --knob sh_every=2", &["--knob sh_every=2", "--sh-every 4", "contradict"]),
        (
            "--policy diet --policy-set diet.grow_every=7 --knob refine_every=9",
            &["--knob refine_every=9", "--policy-set diet.grow_every=7"],
        ),
        ("--policy vanilla --knob score_views=5", &["score_views=5", "vanilla", "views"]),
        ("--knob moment_storage=f16", &["moment_storage", "f32|both8", "works is f32"]),
        (
            "--tile-cap 300 --knob pairs_per_row=1",
            &["--tile-cap 300", "pairs_per_row=1", "contradict"],
        ),
        ("--preset quick", &["quick", "exact, balanced, fast"]),
        ("--preset fast", &["--preset fast", "iterations=15000", "--iterations 24", "contradict"]),
        (
            "--preset exact --knob alpha_min=1/64",
            &["--preset exact", "alpha_min=1/255", "alpha_min=1/64"],
        ),
        ("--preset exact --knob preset=fast", &["preset=fast", "--preset exact"]),
        (
            "--preset tiny-memory --image-cache 1MiB",
            &["--preset tiny-memory", "--image-cache 1MiB"],
        ),
    ];
    for (flags, words) in cases {
        short(scene.path(), &output, flags).refused(flags, words);
        assert!(!output.exists(), "{flags}: something was written");
    }
    // `plan` reads the same words.
    densify(&["plan", text(scene.path()), "--budget", "9", "--knob", "budget=8"])
        .refused("plan", &["--knob budget=8", "--budget 9"]);
}

#[test]
fn a_setting_by_either_name_is_the_same_setting() {
    let scene = Photographs::colmap_text();
    let (root, by_flag) = scratch();
    let by_knob = root.path().join("knob");
    let flags = "--sh-every 2 --tile-cap 300 --policy-set diet.grow_every=5";
    short(scene.path(), &by_flag, flags).ok();
    // The same twice, and in another spelling, is no contradiction.
    let knobs = "--knob sh_every=2 --sh-every 2 --knob tile_cap=3e2 --knob refine_every=5 \
                 --knob sh_degree=1 --knob budget=0.25k --knob image_cache=1GiB";
    short(scene.path(), &by_knob, knobs).ok();
    let config = |run: &Path| String::from_utf8(read(&run.join("config.toml"))).expect("UTF-8");
    assert_eq!(config(&by_flag), config(&by_knob));
    assert!(model(&by_flag, ITERATIONS) == model(&by_knob, ITERATIONS));
}

#[test]
fn a_preset_says_how_long_a_run_is_unless_the_call_does() {
    let scene = Photographs::colmap_text();
    let (_root, output) = scratch();
    // A step beyond the last cannot be saved, and the message names the last.
    let cases = [
        ("", "24000"),
        ("--preset balanced", "24000"),
        ("--preset exact", "30000"),
        ("--preset fast", "15000"),
        ("--preset tiny-memory", "30000"),
        ("--iterations 9", "9"),
        ("--knob iterations=9", "9"),
    ];
    for (flags, last) in cases {
        let words =
            ["train", text(scene.path()), "-o", text(&output), "--save-iterations", "30001"];
        let words: Vec<&str> = words.into_iter().chain(flags.split_whitespace()).collect();
        let range = format!("iterations 1 to {last}");
        densify(&words).refused(flags, &["--save-iterations 30001", &range]);
    }
    // What balanced was measured to cost is not that of a run of another length.
    let said = short(scene.path(), &output, "").ok().stdout;
    let line = format!("preset   none: --iterations {ITERATIONS} is given, and balanced is 24000");
    assert!(said.contains(&line), "{said}");
}

#[test]
fn every_level_does_what_its_class_says() {
    let scene = Photographs::colmap_text();
    let (root, base) = scratch();
    short(scene.path(), &base, "").ok();
    let expected = model(&base, ITERATIONS);
    let defaults: String = KNOBS
        .iter()
        .filter(|knob| knob.how == How::Knob)
        .map(|knob| format!(" --knob {}={}", knob.name, knob.default))
        .collect();
    let spelled = root.path().join("spelled");
    for flags in [&*defaults, "--preset exact"] {
        short(scene.path(), &spelled, &format!("{flags} --overwrite")).ok();
        assert!(expected == model(&spelled, ITERATIONS), "{flags} is not the default");
    }
    let mut changed = 0;
    // Those of a GPU are tried in `accumulation.rs`.
    let here = KNOBS.iter().filter(|knob| knob.on != On::Gpu);
    for knob in here.filter(|knob| knob.how == How::Knob || knob.class == Class::Exact) {
        let levels: Vec<String> = match knob.levels {
            Levels::Values(values) => values.iter().map(|v| (*v).to_owned()).collect(),
            _ => vec!["251".to_owned()],
        };
        for level in levels {
            let (what, run) = (format!("--knob {}={level}", knob.name), root.path().join("level"));
            short(scene.path(), &run, &format!("{what} --overwrite")).ok();
            let same = model(&run, ITERATIONS) == expected;
            assert!(same || knob.class != Class::Exact, "{what} is not exact");
            changed += usize::from(!same);
            let config = String::from_utf8(read(&run.join("config.toml"))).expect("UTF-8");
            let line = format!("{} = \"{level}\"", knob.name);
            assert_eq!(config.contains(&line), knob.how == How::Knob, "{what}: {config}");
        }
    }
    assert!(changed >= 12, "only {changed} levels change anything");
}

#[test]
fn knobs_survive_a_stop_and_cannot_change_in_between() {
    let scene = Photographs::colmap_text();
    let (root, whole) = scratch();
    let flags = format!("{CHANGED} --checkpoint-every 12");
    short(scene.path(), &whole, &flags).ok();
    let part = root.path().join("part");
    for (name, bytes) in files(&whole) {
        if name.contains("iteration_24") {
            continue;
        }
        let path = part.join(name);
        std::fs::create_dir_all(path.parent().expect("a folder")).expect("a folder");
        std::fs::write(path, bytes).expect("a copy");
    }
    let resume = |flags: &str| {
        let words = [
            "train",
            text(scene.path()),
            "-o",
            text(&part),
            "--resume",
            "--checkpoint-every",
            "12",
        ];
        let words: Vec<&str> = words.into_iter().chain(flags.split_whitespace()).collect();
        densify(&words)
    };
    resume("--knob alpha_min=1/32").refused("another value", &["--knob alpha_min", "1/32", "1/64"]);
    resume("--preset exact").refused("a preset", &["--knob alpha_min", "1/255", "1/64"]);
    // Not given, or given again.
    resume("--knob ssim_every=5 --knob sh_degree=1").ok();
    assert!(model(&whole, ITERATIONS) == model(&part, ITERATIONS), "another model");
    let log = |run: &Path| {
        let text = String::from_utf8(read(&run.join("stats/train.jsonl"))).expect("UTF-8");
        let loss = |line: &str| line.split(",\"seconds\"").next().map(str::to_owned);
        text.lines().filter_map(loss).collect::<Vec<_>>()
    };
    assert_eq!(log(&whole), log(&part));
    // SSIM is in every fifth step, and in every record.
    assert!(log(&whole).iter().all(|line| !line.contains("null")), "{:?}", log(&whole));
}
