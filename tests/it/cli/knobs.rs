//! Knobs and presets: on the command line, in `config.toml` and in their effect on the model.

use std::path::Path;

use densify::render::BackendKind;
use densify::run::knobs::{Class, KNOBS, PRESETS};

use super::{Outcome, call, config, copy_unfinished, densify, model, resume, scratch, text, train};
use crate::photographs::Photographs;

const ITERATIONS: u32 = 24;

/// Knobs with values other than their defaults.
const CHANGED: &str = "--knob alpha_min=1/64 --knob transmittance_stop=1e-3 --knob param_storage=f16 \
                       --knob moment_storage=both8 --knob pairs_per_row=2";

fn short(scene: &Path, output: &Path, flags: &str) -> Outcome {
    train(scene, output, ITERATIONS, &format!("--budget 250 --test-every 3 {flags}"))
}

#[test]
fn every_knob_and_preset_is_listed() {
    let stdout = densify(&["knobs"]).ok().stdout;
    for knob in KNOBS {
        assert!(stdout.contains(&format!("  {} ", knob.name)), "{} is not in {stdout}", knob.name);
        assert!(stdout.contains(knob.effect), "{} is not explained", knob.name);
    }
    for preset in PRESETS {
        assert!(stdout.contains(&format!("  {}: {}", preset.name, preset.promise)), "{stdout}");
    }
}

#[test]
fn invalid_knobs_and_presets_are_refused_before_writing() {
    let scene = Photographs::colmap_text();
    let (_root, output) = scratch();
    // The allowed values are tested where knobs are parsed.
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
        assert!(!output.exists(), "{flags}: the output exists");
    }
}

#[test]
fn explicit_options_override_a_preset() {
    let scene = Photographs::colmap_text();
    let (_root, output) = scratch();
    let flags = "--preset tiny-memory --image-cache 1MiB --knob param_storage=f32";
    short(scene.path(), &output, flags).ok();
    let config = config(&output);
    assert_eq!(config["image_cache"].as_integer(), Some(1 << 20));
    let knob = |name: &str| config["knob"][name].as_str();
    assert_eq!([knob("param_storage"), knob("moment_storage")], [Some("f32"), Some("both8")]);
    // Without the option, the preset caches photographs in up to an eighth of the memory.
    let (_root, output) = scratch();
    short(scene.path(), &output, "--preset tiny-memory").ok();
    let kept = self::config(&output)["image_cache"].as_integer();
    assert_eq!(kept, Some(9 * 48 * 40 * 3), "all training views");
}

#[test]
fn presets_set_the_number_of_iterations_unless_it_is_given() {
    let scene = Photographs::colmap_text();
    let (_root, output) = scratch();
    // Saving after the last iteration is refused with a message that names the last.
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
    // The printed cost of `balanced` was measured at its own number of iterations, so it is not printed for others.
    let stdout = short(scene.path(), &output, "").ok().stdout;
    let line =
        format!("preset   none: --iterations {ITERATIONS} overrides balanced, which has 24000");
    assert!(stdout.contains(&line), "{stdout}");
}

#[test]
fn every_level_matches_its_exactness_class() {
    let scene = Photographs::colmap_text();
    let (root, base) = scratch();
    short(scene.path(), &base, "").ok();
    let expected = model(&base, ITERATIONS);
    let defaults: String =
        KNOBS.iter().map(|knob| format!(" --knob {}={}", knob.name, knob.default)).collect();
    let explicit = root.path().join("explicit");
    for flags in [&*defaults, "--preset exact"] {
        short(scene.path(), &explicit, &format!("{flags} --overwrite")).ok();
        assert!(
            expected == model(&explicit, ITERATIONS),
            "{flags} does not give the default model"
        );
    }
    let mut changed = 0;
    // `accumulation.rs` tests the knobs of a GPU.
    for knob in KNOBS.iter().filter(|knob| knob.only_on != Some(BackendKind::Gpu)) {
        for level in knob.levels {
            let (flag, run) = (format!("--knob {}={level}", knob.name), root.path().join("level"));
            short(scene.path(), &run, &format!("{flag} --overwrite")).ok();
            let is_same = model(&run, ITERATIONS) == expected;
            assert!(is_same || knob.class != Class::Exact, "{flag} is not exact");
            changed += usize::from(!is_same);
            assert_eq!(config(&run)["knob"][knob.name].as_str(), Some(*level), "{flag}");
        }
    }
    assert!(changed >= 7, "only {changed} levels change anything");
}

#[test]
fn resumed_runs_keep_their_knobs() {
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
    // Knobs may be left out or repeated with the same value.
    resume("--knob param_storage=f16 --knob alpha_min=0.015625").ok();
    assert!(model(&whole, ITERATIONS) == model(&part, ITERATIONS), "the models differ");
}
