//! How a GPU adds up gradients, from the command line to `config.toml` and back.

use std::path::Path;

use densify::render::gpu::GpuDevice;

use super::{Outcome, config, copy_unfinished, densify, model, scratch, text};
use crate::photographs::Photographs;
use crate::subject::{devices, ways};

const ITERATIONS: u32 = 8;

fn run(scene: &Path, output: &Path, flags: &[&str]) -> Outcome {
    let call = ["train", text(scene), "-o", text(output), "--iterations", "8", "--budget", "250"];
    densify(&[&call[..], &["--sh-degree", "1", "--checkpoint-every", "4"], flags].concat())
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
        assert_eq!(config(&whole)["knob"]["accumulation"].as_str(), Some(way.name()));

        let part = root.path().join("part");
        copy_unfinished(&whole, &part, ITERATIONS);
        let call = ["train", text(scene.path()), "-o", text(&part), "--resume"];
        let resume = |flags: &[&str]| densify(&[&call[..], flags].concat());
        let other = if way.is_deterministic() { "cas" } else { "slots" };
        let another = format!("accumulation={other}");
        resume(&["--knob", &another]).refused("another way", &["--knob accumulation", other]);
        let processor = resume(&["--backend", "cpu"]);
        processor.refused("no GPU", &["--gpu", &device.adapter().name, "in that run"]);
        if way.is_deterministic() {
            resume(&["--deterministic"]).ok();
            assert!(model(&whole, ITERATIONS) == model(&part, ITERATIONS), "another model");
        } else {
            let refused = resume(&["--deterministic"]);
            refused.refused("in slots", &["--knob accumulation", "slots", way.name()]);
            resume(&[]).ok();
            assert_eq!(config(&part)["knob"]["accumulation"].as_str(), Some(way.name()));
        }
    }
}

#[test]
fn what_is_deterministic_repeats_on_every_device() {
    let scene = Photographs::colmap_text();
    let on_devices = devices().iter().map(|device| ["--gpu", &*device.adapter().name]);
    for device in on_devices.chain([["--backend", "cpu"]]) {
        let [first, second] = [(); 2].map(|()| {
            let (_root, output) = scratch();
            let flags = [&device[..], &["--deterministic"]].concat();
            run(scene.path(), &output, &flags).ok();
            model(&output, ITERATIONS)
        });
        assert!(first == second, "{device:?}");
    }
}

#[test]
fn contradictions_and_what_a_device_lacks_are_refused_by_name() {
    let scene = Photographs::colmap_text();
    let (_root, output) = scratch();
    let try_with = |flags: &[&str]| run(scene.path(), &output, flags);
    for way in ["cas", "atomics"] {
        let knob = format!("accumulation={way}");
        try_with(&["--deterministic", "--knob", &knob])
            .refused(way, &["--deterministic", "accumulation=slots", &knob, "contradict"]);
        try_with(&["--backend", "cpu", "--knob", &knob])
            .refused(way, &[&knob, "native backend", "accumulation=auto", "--backend gpu"]);
    }
    try_with(&["--knob", "accumulation=fast"]).refused("no such way", &["auto|slots|cas|atomics"]);
    for adapter in devices().iter().map(GpuDevice::adapter) {
        for (way, feature) in [("cas", "SUBGROUP"), ("atomics", "SHADER_FLOAT32_ATOMIC")] {
            if adapter.accumulations.iter().all(|there| there.name() != way) {
                let knob = format!("accumulation={way}");
                try_with(&["--gpu", &adapter.name, "--knob", &knob])
                    .refused(way, &[&adapter.name, feature, "accumulation=slots"]);
            }
        }
    }
    assert!(!output.exists(), "something was written");
}

#[test]
fn devices_say_how_they_add_up() {
    let listed = densify(&["devices"]).ok().stdout;
    for adapter in devices().iter().map(GpuDevice::adapter) {
        let about = listed.lines().skip_while(|line| *line != adapter.name);
        let line = about.into_iter().find_map(|line| line.strip_prefix("  accumulation    "));
        let line = line.expect("a line");
        assert!(line.starts_with(adapter.accumulation().name()), "{listed}");
        let ways = &adapter.accumulations;
        assert!(ways.iter().all(|way| line.contains(way.name())), "{listed}");
    }
}
