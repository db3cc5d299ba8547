//! How a GPU adds up gradients, from the command line to `config.toml` and back.

use std::path::Path;

use super::{Outcome, densify, files, model, read, scratch, text};
use crate::photographs::Photographs;
use crate::subject::{devices, ways};

const ITERATIONS: u32 = 8;

fn run(scene: &Path, output: &Path, flags: &[&str]) -> Outcome {
    let call = ["train", text(scene), "-o", text(output), "--iterations", "8", "--budget", "250"];
    densify(&[&call[..], &["--sh-degree", "1", "--checkpoint-every", "4"], flags].concat())
}

/// The knob as a run has it.
fn kept(run: &Path) -> String {
    let config = String::from_utf8(read(&run.join("config.toml"))).expect("UTF-8");
    let line = config.lines().find_map(|line| line.strip_prefix("accumulation = "));
    line.expect("the knob").trim_matches('"').to_owned()
}

#[test]
fn a_run_adds_up_as_it_is_told_and_keeps_to_it() {
    let scene = Photographs::colmap_text();
    for device in ways() {
        let (root, whole) = scratch();
        let (gpu, way) = (["--gpu", &*device.adapter().name], device.accumulation());
        let knob = format!("accumulation={way}");
        let told = run(scene.path(), &whole, &[&gpu[..], &["--knob", &knob]].concat()).ok();
        let line = told.stdout.lines().find(|line| line.starts_with("sums ")).expect("a line");
        assert!(line.contains(&knob), "{line}");
        assert_eq!(line.contains("--deterministic"), !way.is_deterministic(), "{line}");
        assert_eq!(kept(&whole), way.name());

        // A run that was stopped after its first checkpoint.
        let part = root.path().join("part");
        for (name, bytes) in files(&whole) {
            if !name.contains("iteration_8") && !name.contains("step_8") {
                let path = part.join(name);
                std::fs::create_dir_all(path.parent().expect("a folder")).expect("a folder");
                std::fs::write(path, bytes).expect("a copy");
            }
        }
        let call = ["train", text(scene.path()), "-o", text(&part), "--resume"];
        let resume = |flags: &[&str]| densify(&[&call[..], flags].concat());
        let other = if way.is_deterministic() { "cas" } else { "slots" };
        let another = format!("accumulation={other}");
        resume(&["--knob", &another]).refused("another way", &["--knob accumulation", other]);
        let processor = resume(&["--backend", "cpu"]);
        processor.refused("no GPU", &["--gpu", &device.adapter().name, "in the checkpoint"]);
        if way.is_deterministic() {
            resume(&["--deterministic"]).ok();
            assert!(model(&whole, ITERATIONS) == model(&part, ITERATIONS), "another model");
        } else {
            let refused = resume(&["--deterministic"]);
            refused.refused("in slots", &["--knob accumulation", "slots", way.name()]);
            resume(&[]).ok();
            assert_eq!(kept(&part), way.name());
            assert_eq!(model(&whole, ITERATIONS).len(), model(&part, ITERATIONS).len());
        }
    }
}

#[test]
fn what_is_deterministic_repeats_on_every_device() {
    let scene = Photographs::colmap_text();
    for device in devices() {
        let (root, first) = scratch();
        let second = root.path().join("second");
        let flags = ["--gpu", &device.adapter().name, "--deterministic"];
        for output in [&first, &second] {
            run(scene.path(), output, &flags).ok();
            assert_eq!(kept(output), "slots");
        }
        assert!(model(&first, ITERATIONS) == model(&second, ITERATIONS));
    }
}

#[test]
fn contradictions_and_what_a_device_lacks_are_refused_by_name() {
    let scene = Photographs::colmap_text();
    let (_root, output) = scratch();
    let try_with = |flags: &str| {
        let flags: Vec<&str> = flags.split_whitespace().collect();
        run(scene.path(), &output, &flags)
    };
    for way in ["cas", "atomics"] {
        let given = format!("--knob accumulation={way}");
        try_with(&format!("--deterministic {given}"))
            .refused(way, &["--deterministic", "accumulation=slots", &given, "contradict"]);
        try_with(&format!("--backend cpu {given}"))
            .refused(way, &[&given[7..], "native backend", "accumulation=auto", "--backend gpu"]);
    }
    try_with("--knob accumulation=fast").refused("no such way", &["auto|slots|cas|atomics"]);
    for device in devices() {
        let adapter = device.adapter();
        for (way, feature) in [("cas", "SUBGROUP"), ("atomics", "SHADER_FLOAT32_ATOMIC")] {
            if adapter.accumulations.iter().all(|there| there.name() != way) {
                let knob = format!("accumulation={way}");
                let refused =
                    run(scene.path(), &output, &["--gpu", &adapter.name, "--knob", &knob]);
                refused.refused(way, &[&adapter.name, feature, "accumulation=slots"]);
            }
        }
    }
    assert!(!output.exists(), "something was written");
}

#[test]
fn the_processor_is_deterministic_with_and_without_being_told() {
    let scene = Photographs::colmap_text();
    let (root, told) = scratch();
    let untold = root.path().join("untold");
    run(scene.path(), &told, &["--backend", "cpu", "--deterministic"]).ok();
    run(scene.path(), &untold, &["--backend", "cpu", "--knob", "accumulation=auto"]).ok();
    assert!(model(&told, ITERATIONS) == model(&untold, ITERATIONS));
    assert_eq!([kept(&told), kept(&untold)], ["auto", "auto"]);
}

#[test]
fn devices_say_how_they_add_up() {
    let listed = densify(&["devices"]).ok().stdout;
    let lines = listed.lines().filter_map(|line| line.strip_prefix("  accumulation    "));
    let found: Vec<&str> = lines.collect();
    for device in devices() {
        let adapter = device.adapter();
        let place = listed.lines().filter(|line| !line.starts_with(' '));
        let place = place.take_while(|line| *line != adapter.name).count();
        assert!(found[place].starts_with(adapter.accumulation().name()), "{listed}");
        for way in &adapter.accumulations {
            assert!(found[place].contains(way.name()), "{way} is not in {listed}");
        }
    }
}
