//! The knob `accumulation`, which selects how a GPU sums gradients: on the command line and in `config.toml`.

use std::path::Path;

use densify::render::gpu::GpuDevice;

use super::{Outcome, config, copy_unfinished, densify, model, scratch, text};
use crate::photographs::Photographs;
use crate::subject::{devices, devices_by_accumulation};

const ITERATIONS: u32 = 8;

fn run(scene: &Path, output: &Path, flags: &[&str]) -> Outcome {
    let call = ["train", text(scene), "-o", text(output), "--iterations", "8", "--budget", "250"];
    densify(&[&call[..], &["--sh-degree", "1", "--checkpoint-every", "4"], flags].concat())
}

#[test]
fn the_accumulation_method_is_used_and_kept_on_resume() {
    let scene = Photographs::colmap_text();
    for device in devices_by_accumulation() {
        let (root, whole) = scratch();
        let (gpu, method) = (["--gpu", &*device.adapter().name], device.accumulation());
        let knob = format!("accumulation={method}");
        let outcome = run(scene.path(), &whole, &[&gpu[..], &["--knob", &knob]].concat()).ok();
        let line = outcome.stdout.lines().find(|line| line.starts_with("sums ")).expect("a line");
        assert!(line.contains(&knob), "{line}");
        assert_eq!(line.contains("--deterministic"), !method.is_deterministic(), "{line}");
        assert_eq!(config(&whole)["knob"]["accumulation"].as_str(), Some(method.name()));

        let part = root.path().join("part");
        copy_unfinished(&whole, &part, ITERATIONS);
        let call = ["train", text(scene.path()), "-o", text(&part), "--resume"];
        let resume = |flags: &[&str]| densify(&[&call[..], flags].concat());
        let other = if method.is_deterministic() { "cas" } else { "slots" };
        let another = format!("accumulation={other}");
        resume(&["--knob", &another]).refused("another method", &["--knob accumulation", other]);
        let processor = resume(&["--backend", "cpu"]);
        processor.refused("no GPU", &["--gpu", &device.adapter().name, "in that run"]);
        if method.is_deterministic() {
            resume(&["--deterministic"]).ok();
            assert!(model(&whole, ITERATIONS) == model(&part, ITERATIONS), "the models differ");
        } else {
            let refused = resume(&["--deterministic"]);
            refused.refused("not deterministic", &["--knob accumulation", "slots", method.name()]);
            resume(&[]).ok();
            assert_eq!(config(&part)["knob"]["accumulation"].as_str(), Some(method.name()));
        }
    }
}

#[test]
fn deterministic_runs_are_reproducible_on_every_device() {
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
fn contradictory_or_unsupported_methods_are_refused() {
    let scene = Photographs::colmap_text();
    let (_root, output) = scratch();
    let try_with = |flags: &[&str]| run(scene.path(), &output, flags);
    for method in ["cas", "atomics"] {
        let knob = format!("accumulation={method}");
        try_with(&["--deterministic", "--knob", &knob])
            .refused(method, &["--deterministic", "accumulation=slots", &knob, "contradict"]);
        try_with(&["--backend", "cpu", "--knob", &knob])
            .refused(method, &[&knob, "native backend", "accumulation=auto", "--backend gpu"]);
    }
    try_with(&["--knob", "accumulation=fast"])
        .refused("no such method", &["auto|slots|cas|atomics"]);
    for adapter in devices().iter().map(GpuDevice::adapter) {
        for (method, feature) in [("cas", "SUBGROUP"), ("atomics", "SHADER_FLOAT32_ATOMIC")] {
            if adapter.accumulations.iter().all(|supported| supported.name() != method) {
                let knob = format!("accumulation={method}");
                try_with(&["--gpu", &adapter.name, "--knob", &knob])
                    .refused(method, &[&adapter.name, feature, "accumulation=slots"]);
            }
        }
    }
    assert!(!output.exists(), "the output exists");
}

#[test]
fn devices_lists_the_accumulation_methods() {
    let listed = densify(&["devices"]).ok().stdout;
    for adapter in devices().iter().map(GpuDevice::adapter) {
        let entry = listed.lines().skip_while(|line| *line != adapter.name);
        let line = entry.into_iter().find_map(|line| line.strip_prefix("  accumulation    "));
        let line = line.expect("a line");
        assert!(line.starts_with(adapter.accumulation().name()), "{listed}");
        let methods = &adapter.accumulations;
        assert!(methods.iter().all(|method| line.contains(method.name())), "{listed}");
    }
}

/// Narrow parameters and moments on a device survive a checkpoint.
#[test]
fn tiny_memory_resumes_exactly_on_every_device() {
    let scene = Photographs::colmap_text();
    for device in devices() {
        let (root, whole) = scratch();
        let gpu = ["--gpu", &*device.adapter().name, "--deterministic", "--preset", "tiny-memory"];
        run(scene.path(), &whole, &gpu).ok();
        let knobs = &config(&whole)["knob"];
        for (name, value) in
            [("param_storage", "f16"), ("moment_storage", "both8"), ("pairs_per_row", "1")]
        {
            assert_eq!(knobs[name].as_str(), Some(value));
        }
        let part = root.path().join("part");
        copy_unfinished(&whole, &part, ITERATIONS);
        densify(&["train", text(scene.path()), "-o", text(&part), "--resume"]).ok();
        assert!(model(&whole, ITERATIONS) == model(&part, ITERATIONS), "the models differ");
    }
}
