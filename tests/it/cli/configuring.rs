//! Configuration files of runs: accepted keys, precedence of flags, and refused values.

use std::path::Path;
use std::process::Command;

use densify::run::{OPTIONS, Occupied, Partial, Run, Silent};

use super::{call, config, files, model, read, scratch, text, train};
use crate::photographs::Photographs;

const ITERATIONS: u32 = 12;

fn write(folder: &Path, text: &str) -> String {
    let path = folder.join("run.toml");
    std::fs::write(&path, text).expect("written");
    path.to_str().expect("temporary paths are UTF-8").to_owned()
}

#[test]
fn flags_override_the_configuration_file() {
    let scene = Photographs::colmap_text();
    let (root, by_flags) = scratch();
    let train = |words: &str, to: &Path| call(&format!("train {words} -o {}", text(to))).ok();
    let flags = "-i 12 --budget 250 --sh-degree 1 --seed 5 --knob alpha_min=1/64 --eval";
    let described = format!("{} {flags} --policy-set diet.rho=0.2", text(scene.path()));
    train(&described, &by_flags);
    // The same run from a file, except for the seed, which a flag overrides.
    let file = write(
        root.path(),
        &format!(
            "scene = {:?}\niterations = 12\nbudget = \"0.25k\"\nsh_degree = 1\neval = true\nseed = 9\n\
             [knob]\nalpha_min = 0.015625\n[policy_set.diet]\nrho = 0.2\n",
            scene.path()
        ),
    );
    // The `config.toml` that a run writes reproduces the run.
    let config = by_flags.join("config.toml");
    for flags in [format!("--config {file} --seed 5"), format!("--config {}", text(&config))] {
        let again = root.path().join("again");
        train(&format!("{flags} --overwrite"), &again);
        assert!(model(&by_flags, ITERATIONS) == model(&again, ITERATIONS), "{flags}");
        assert!(read(&config) == read(&again.join("config.toml")), "{flags}");
    }
    // The library reproduces it, too.
    let library = root.path().join("library");
    let mut spec =
        Partial::read(&config).and_then(Partial::describe).expect("a valid configuration");
    spec.output.output = Some(library.clone());
    spec.device.backend = densify::render::BackendChoice::Cpu;
    let run = Run::prepare(&spec).expect("a valid run");
    assert_eq!(run.train(Occupied::Refuse, &Silent).expect("a trained run"), library);
    assert!(model(&by_flags, ITERATIONS) == model(&library, ITERATIONS));
}

#[test]
fn config_toml_contains_every_option_of_a_run() {
    let scene = Photographs::colmap_text();
    let (_root, run) = scratch();
    train(scene.path(), &run, 2, "--budget 250").ok();
    let config = config(&run);
    // Options without a value in this run are left out. The output folder and `--view` are never saved.
    let unset = [
        "test_every",
        "antialias",
        "depth",
        "depth_unit",
        "depth_along",
        "depth_points",
        "depth_weight",
        "depth_term",
        "distortion_weight",
        "images",
        "resolution",
        "init_points",
        "memory",
        "preset",
        "sparse",
        "views",
        "freeze",
        "policy_file",
        "gpu",
        "threads",
    ];
    let never_saved = ["output", "view"];
    for option in OPTIONS {
        let is_unset = unset.contains(&option.name) || never_saved.contains(&option.name);
        assert_eq!(config.contains_key(option.name), !is_unset, "{}", option.name);
    }
}

#[test]
fn invalid_keys_and_values_are_refused_by_key() {
    let scene = Photographs::colmap_text();
    let cases: [(&str, &[&str]); 12] = [
        ("budgte = 3", &["budgte", "budget"]),
        ("budget = true", &["budget", "200000", "auto"]),
        ("budget = 0", &["budget", "out of range"]),
        ("near = 1.5", &["near", "less than 1"]),
        ("near = \"x\"", &["near", "not a number"]),
        ("sh_degree = 4", &["sh_degree", "0, 1, 2, 3"]),
        ("backend = \"cuda\"", &["backend", "cpu"]),
        ("iterations = 0", &["iterations", "from 1"]),
        ("eval = \"yes\"", &["eval", "boolean"]),
        ("[knob]\nalpha_mim = 1", &["alpha_mim", "alpha_min"]),
        ("[policy_set.dite]\nrho = 1", &["dite", "diet"]),
        ("[lr]\nopacty = 1", &["opacty", "opacity"]),
    ];
    for (line, words) in cases {
        let (root, output) = scratch();
        let file = write(root.path(), line);
        let words: Vec<&str> = words.iter().copied().chain(["run.toml"]).collect();
        let (scene, to) = (text(scene.path()), text(&output));
        call(&format!("train {scene} --config {file} -o {to}")).refused(line, &words);
        assert_eq!(files(root.path()).len(), 1, "{line}: something was written");
    }
    call("train --config no.toml").refused("no file", &["no.toml"]);
    call("train -o run").refused("no scene", &["no scene", "scene:spheres"]);
}

#[test]
fn an_invalid_log_filter_is_reported() {
    let mut program = Command::new(env!("CARGO_BIN_EXE_densify"));
    let output = program.arg("knobs").env("RUST_LOG", "densify[step{view=3}]=debug").output();
    let output = output.expect("the program starts");
    let log = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && log.contains("RUST_LOG is ignored"), "{log}");
}
