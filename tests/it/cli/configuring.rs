//! Runs described by a file: what it may say, what wins over it, and what is refused.

use std::path::Path;
use std::process::Command;

use densify::run::{OPTIONS, Occupied, Partial, Run, Silent};

use super::{call, config, files, model, read, scratch, text, train};
use crate::photographs::Photographs;

const ITERATIONS: u32 = 12;

fn write(folder: &Path, text: &str) -> String {
    let path = folder.join("run.toml");
    std::fs::write(&path, text).expect("it is written");
    path.to_str().expect("temporary paths are UTF-8").to_owned()
}

#[test]
fn a_file_describes_a_run_and_flags_win_over_it() {
    let scene = Photographs::colmap_text();
    let (root, by_flags) = scratch();
    let train = |what: &str, to: &Path| call(&format!("train {what} -o {}", text(to))).ok();
    let flags = "-i 12 --budget 250 --sh-degree 1 --seed 5 --knob alpha_min=1/64 --eval";
    let described = format!("{} {flags} --policy-set diet.rho=0.2", text(scene.path()));
    train(&described, &by_flags);
    // The same from a file, but for the seed, which a flag gives.
    let file = write(
        root.path(),
        &format!(
            "scene = {:?}\niterations = 12\nbudget = \"0.25k\"\nsh_degree = 1\neval = true\nseed = 9\n\
             [knob]\nalpha_min = 0.015625\n[policy_set.diet]\nrho = 0.2\n",
            scene.path()
        ),
    );
    // A run's own file repeats it.
    let config = by_flags.join("config.toml");
    for what in [format!("--config {file} --seed 5"), format!("--config {}", text(&config))] {
        let again = root.path().join("again");
        train(&format!("{what} --overwrite"), &again);
        assert!(model(&by_flags, ITERATIONS) == model(&again, ITERATIONS), "{what}");
        assert!(read(&config) == read(&again.join("config.toml")), "{what}");
    }
    // So does a program without the command line.
    let library = root.path().join("library");
    let mut spec = Partial::read(&config).and_then(Partial::describe).expect("it is sound");
    spec.output.output = Some(library.clone());
    spec.device.backend = densify::render::BackendChoice::Cpu;
    let run = Run::prepare(&spec).expect("it was prepared before");
    assert_eq!(run.train(Occupied::Refuse, &Silent).expect("it trains"), library);
    assert!(model(&by_flags, ITERATIONS) == model(&library, ITERATIONS));
}

#[test]
fn a_run_has_every_option_in_its_file() {
    let scene = Photographs::colmap_text();
    let (_root, run) = scratch();
    train(scene.path(), &run, 2, "--budget 250").ok();
    let config = config(&run);
    // What is not set is what there is nothing to set to.
    let unset = [
        "test_every",
        "images",
        "resolution",
        "init_points",
        "memory",
        "preset",
        "views",
        "freeze",
    ];
    let elsewhere = ["gpu", "threads", "output", "view"];
    for option in OPTIONS {
        let is_unset = unset.contains(&option.name) || elsewhere.contains(&option.name);
        assert_eq!(config.contains_key(option.name), !is_unset, "{}", option.name);
    }
}

#[test]
fn files_that_say_what_cannot_be_are_refused_by_key() {
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
fn a_log_filter_that_is_not_understood_is_named() {
    let mut program = Command::new(env!("CARGO_BIN_EXE_densify"));
    let said = program.arg("knobs").env("RUST_LOG", "densify[step{view=3}]=debug").output();
    let said = said.expect("it starts");
    let log = String::from_utf8_lossy(&said.stderr);
    assert!(said.status.success() && log.contains("RUST_LOG is not used"), "{log}");
}
