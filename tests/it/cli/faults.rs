//! Invalid input: exit code 2, one message that names the file, field or flag and the remedy, and no files left
//! behind. Damaged data files are tested case by case beside their readers.

use std::path::Path;

use densify::run::{Budget, ImageCache, Observer, Occupied, Run, RunSpec, Whole};

use super::{call, files, json, model, resume, scratch, text, train};
use crate::photographs::Photographs;

/// Trains with additional flags and checks that they are refused with these words.
fn refused(scene: &Photographs, flags: &str, words: &[&str]) {
    let (root, run) = scratch();
    let budget = if flags.contains("--budget") { "" } else { "--budget 400 " };
    train(scene.path(), &run, 20, &format!("{budget}{flags}")).refused(flags, words);
    assert!(!run.exists(), "{flags}: left behind: {:?}", files(root.path()).keys());
}

#[test]
fn flags_out_of_range_are_refused() {
    let scene = Photographs::colmap_text();
    let faults: &[(&str, &[&str])] = &[
        ("--policy diett", &["diett", "`diet`"]),
        ("--policy-set diet.rhoo=0.2", &["rhoo", "`rho`"]),
        ("--policy-set diet.rho=-1", &["rho"]),
        ("--policy-set diet.rho=much", &["rho", "much"]),
        ("--policy-set rho", &["--policy-set", "rho"]),
        ("--policy-set vanilla.tau=1", &["vanilla", "--policy"]),
        ("--budget 0", &["--budget", "at least 1"]),
        ("--budget many", &["--budget", "many", "200k"]),
        ("--budget 0.5", &["--budget", "0.5"]),
        ("--budget 5000M", &["--budget", "4 billion"]),
        ("--test-every 1", &["no view is left", "--test-every"]),
        ("--test-every 0", &["--test-every"]),
        ("--image-cache much", &["--image-cache", "1GiB", "auto"]),
        ("--background mauve", &["--background", "mauve", "#808080"]),
        ("--lr opacity=x", &["--lr", "NAME=RATE"]),
        ("--lr colour=1", &["--lr", "colour"]),
        ("--save-iterations 21", &["--save-iterations", "1 to 20"]),
        ("--test-iterations 5", &["--test-iterations", "--eval"]),
        ("--images photos", &["photos"]),
        ("--init points --init-points 5", &["--init-points"]),
        ("--near 1", &["--near", "less than 1"]),
        ("--config /no/such/file", &["--config", "/no/such"]),
        ("--full --budget auto", &["--full", "--budget auto"]),
        ("--threads 1000", &["--threads", "`1000`", "from 1 to 256"]),
        ("--threads 0", &["--threads", "from 1 to 256"]),
        ("--budget none", &["--budget", "auto"]),
    ];
    for (flags, words) in faults {
        refused(&scene, flags, words);
    }
    refused(&Photographs::transforms(), "--init points", &["--init random"]);
}

#[test]
fn damaged_datasets_are_refused() {
    let scene = Photographs::colmap_text();
    std::fs::remove_file(scene.file("images/view_03.png")).expect("a view");
    refused(&scene, "", &["images.txt", "view_03.png", "--images"]);
    scene.truncate("sparse/0/points3D.txt", 12);
    refused(&scene, "", &["points3D.txt", "line 300"]);
    std::fs::remove_dir_all(scene.file("sparse")).expect("the model");
    // `train` would find the cameras of the photographs.
    call(&format!("plan {}", text(scene.path()))).refused("plan", &["is not a dataset", "COLMAP"]);
}

/// The header is valid, so the damage shows only when training decodes the pixels.
#[test]
fn a_truncated_photograph_ends_the_run() {
    let scene = Photographs::colmap_text();
    scene.truncate("images/view_03.png", 600);
    refused(&scene, "--quiet", &["images/view_03.png", "cannot decode"]);
    // Files that were saved before the failure are kept, and the message says where.
    let (_root, run) = scratch();
    let flags = "--budget 400 --quiet --save-iterations 1 --seed 4";
    let outcome = train(scene.path(), &run, 20, flags);
    outcome.refused("cut short", &["cannot decode", "files written so far are in"]);
    assert!(!model(&run, 1).is_empty());
    assert_eq!(json(&run.join("stats/summary.json"))["finished"], false);
}

#[test]
fn missing_scenes_and_occupied_outputs_are_refused() {
    let (root, run) = scratch();
    let scene = root.path().join("no-such-folder");
    train(&scene, &run, 20, "").refused("no scene", &["no-such-folder", "check that it exists"]);
    assert!(!run.exists());

    let photographs = Photographs::colmap_text();
    let (here, dataset) = (text(root.path()), text(photographs.path()));
    std::fs::write(&run, "a file").unwrap();
    train(photographs.path(), &run, 20, "").refused("a file", &["not a folder", "-o"]);
    assert_eq!(std::fs::read(&run).unwrap(), b"a file");

    call(&format!("eval {here}")).refused("eval", &["holds no run", "densify train"]);
    let pictures = root.path().join("pictures");
    let render = |words: &str| call(&format!("render {words} -o {}", text(&pictures)));
    render(here).refused("render", &["holds no run"]);
    let ply = root.path().join("model.ply");
    std::fs::write(&ply, "ply\nformat ascii 1.0\nend_header\n").unwrap();
    render(&format!("{} --scene {dataset} --split train", text(&ply)))
        .refused("no splats", &["model.ply"]);
    assert!(!pictures.exists());
    assert_eq!(files(root.path()).len(), 2, "something was left behind");
}

/// Truncates a photograph after the given step.
struct TruncateAfter<'a>(&'a Photographs, u32);

impl Observer for TruncateAfter<'_> {
    fn step(&self, step: u32, _: f32, _: usize) {
        if step == self.1 {
            self.0.truncate("images/view_03.png", 600);
        }
    }
}

#[test]
fn a_photograph_damaged_during_a_run_loses_no_completed_step() {
    let scene = Photographs::colmap_text();
    let intact_photograph = std::fs::read(scene.file("images/view_03.png")).expect("a view");
    let (root, whole) = scratch();
    let train = |run: &Path, cut_after: u32| {
        let mut spec = RunSpec::default();
        spec.start.scene = Some(scene.path().into());
        spec.output.output = Some(run.into());
        spec.device.backend = densify::render::BackendChoice::Cpu;
        spec.size.budget = Some(Budget::Rows(400));
        spec.size.image_cache = Some(ImageCache::Bytes(0));
        spec.schedule.iterations = Whole(48);
        let run = Run::prepare(&spec).expect("a run");
        run.train(Occupied::Refuse, &TruncateAfter(&scene, cut_after))
    };
    train(&whole, 0).expect("the whole run");
    // Only a few of the fourteen views are decoded in advance, so the damaged one is still read from disk.
    for cut_after in [16, 28] {
        let part = root.path().join(format!("part{cut_after}"));
        let failure = train(&part, cut_after).expect_err("a truncated photograph");
        let message = &failure.to_string();
        let step = message.strip_prefix("step ").and_then(|rest| rest.split(':').next());
        let step: u32 = step.and_then(|step| step.parse().ok()).expect(message);
        assert!(step > cut_after && message.contains("--resume"), "{message}");
        let checkpoint = format!("iteration_{}.safetensors", step - 1);
        assert!(failure.code == 2 && message.contains(&checkpoint), "{message}");
        scene.write("images/view_03.png", &intact_photograph);
        resume(scene.path(), &part, "").ok();
        assert!(model(&part, 48) == model(&whole, 48), "cut after {cut_after}");
    }
}
