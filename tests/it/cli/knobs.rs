//! Knobs and presets, from the command line to the bytes of a run and back.

use std::path::Path;

use densify::render::BackendKind;
use densify::run::knobs::{Class, KNOBS, PRESETS};

use super::{Outcome, call, config, copy_unfinished, densify, model, resume, scratch, text, train};
use crate::photographs::Photographs;

const ITERATIONS: u32 = 24;

/// Knobs that are not as they are by default.
const CHANGED: &str = "--knob alpha_min=1/64 --knob transmittance_stop=1e-3 --knob param_storage=f16 \
                       --knob moment_storage=both8 --knob pairs_per_row=2";

fn short(scene: &Path, output: &Path, flags: &str) -> Outcome {
    train(scene, output, ITERATIONS, &format!("--budget 250 --test-every 3 {flags}"))
}

#[test]
fn every_knob_and_preset_is_listed() {
    let said = densify(&["knobs"]).ok().stdout;
    for knob in KNOBS {
        assert!(said.contains(&format!("  {} ", knob.name)), "{} is not in {said}", knob.name);
        assert!(said.contains(knob.effect), "{} is not explained", knob.name);
    }
    for preset in PRESETS {
        assert!(said.contains(&format!("  {}: {}", preset.name, preset.promise)), "{said}");
    }
}

#[test]
fn what_cannot_be_is_refused_before_anything_is_written() {
    let scene = Photographs::colmap_text();
    let (_root, output) = scratch();
    // What values a knob may have is in `src/knobs/tests.rs`.
    let cases: [(&str, &[&str]); 5] = [
        ("--knob alpha_min=0.5", &["alpha_min", "0.5", "1/32"]),
        ("--knob alpha_min", &["--knob", "NAME=VALUE"]),
        ("--knob alpha_min=1/64 --knob alpha_min=1/32", &["1/64", "1/32", "contradict"]),
        (
            "--tile-cap 300 --knob pairs_per_row=1",
            &["--tile-cap 300", "pairs_per_row=1", "contradict"],
        ),
        ("--preset quick", &["quick", "exact, balanced, fast"]),
    ];
    for (flags, words) in cases {
        short(scene.path(), &output, flags).refused(flags, words);
        assert!(!output.exists(), "{flags}: something was written");
    }
}

#[test]
fn options_that_are_given_win_over_a_preset() {
    let scene = Photographs::colmap_text();
    let (_root, output) = scratch();
    let flags = "--preset tiny-memory --image-cache 1MiB --knob param_storage=f32";
    short(scene.path(), &output, flags).ok();
    let config = config(&output);
    assert_eq!(config["image_cache"].as_integer(), Some(1 << 20));
    let knob = |name: &str| config["knob"][name].as_str();
    assert_eq!([knob("param_storage"), knob("moment_storage")], [Some("f32"), Some("both8")]);
    // By itself the preset keeps photographs in an eighth of the run, if they fit.
    let (_root, output) = scratch();
    short(scene.path(), &output, "--preset tiny-memory").ok();
    let kept = self::config(&output)["image_cache"].as_integer();
    assert_eq!(kept, Some(9 * 48 * 40 * 3), "all that are trained on");
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
        ("--preset fast --iterations 9", "9"),
    ];
    for (flags, last) in cases {
        let (scene, output) = (text(scene.path()), text(&output));
        call(&format!("train {scene} -o {output} --save-iterations 30001 {flags}"))
            .refused(flags, &["--save-iterations 30001", &format!("iterations 1 to {last}")]);
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
    let defaults: String =
        KNOBS.iter().map(|knob| format!(" --knob {}={}", knob.name, knob.default)).collect();
    let spelled = root.path().join("spelled");
    for flags in [&*defaults, "--preset exact"] {
        short(scene.path(), &spelled, &format!("{flags} --overwrite")).ok();
        assert!(expected == model(&spelled, ITERATIONS), "{flags} is not the default");
    }
    let mut changed = 0;
    // Those of a GPU are tried in `accumulation.rs`.
    for knob in KNOBS.iter().filter(|knob| knob.only_on != Some(BackendKind::Gpu)) {
        for level in knob.levels {
            let (what, run) = (format!("--knob {}={level}", knob.name), root.path().join("level"));
            short(scene.path(), &run, &format!("{what} --overwrite")).ok();
            let same = model(&run, ITERATIONS) == expected;
            assert!(same || knob.class != Class::Exact, "{what} is not exact");
            changed += usize::from(!same);
            assert_eq!(config(&run)["knob"][knob.name].as_str(), Some(*level), "{what}");
        }
    }
    assert!(changed >= 7, "only {changed} levels change anything");
}

#[test]
fn knobs_survive_a_stop_and_cannot_change_in_between() {
    let scene = Photographs::colmap_text();
    let (root, whole) = scratch();
    let flags = format!("{CHANGED} --checkpoint-every 12");
    short(scene.path(), &whole, &flags).ok();
    let part = root.path().join("part");
    copy_unfinished(&whole, &part, ITERATIONS);
    let resume =
        |flags: &str| resume(scene.path(), &part, &format!("--checkpoint-every 12 {flags}"));
    resume("--knob alpha_min=1/32").refused("another value", &["--knob alpha_min", "1/32", "1/64"]);
    resume("--preset exact").refused("a preset", &["--knob alpha_min", "1/255", "1/64"]);
    // Not given, or given again.
    resume("--knob param_storage=f16 --knob alpha_min=0.015625").ok();
    assert!(model(&whole, ITERATIONS) == model(&part, ITERATIONS), "another model");
}
