//! Studies that take a night: limited by time or by memory, with as many seeds as decide, and after failures.

use std::path::Path;

use assert_cmd::Command;
use densify::train::output::FolderLock;

use super::{Outcome, call, count, files, json, outcome_of, read_text, records, scratch, text};
use crate::photographs::Photographs;

/// Compares two policies in short runs.
fn compare(scene: &Path, output: &Path, more: &str) -> Outcome {
    call(&words(scene, output, more))
}

fn words(scene: &Path, output: &Path, more: &str) -> String {
    format!("compare {} -o {} --policies vanilla,diet -i 24 {more}", text(scene), text(output))
}

const FLAGS: &str = "-- --sh-degree 0";

#[test]
fn hours_start_only_what_fits_and_the_same_command_goes_on() {
    let scene = Photographs::colmap_text();
    let (_root, output) = scratch();
    let seeds = |seeds: u32, more: &str| {
        compare(scene.path(), &output, &format!("-b 250,320 --seeds {seeds} {more} {FLAGS}"))
    };
    // Shorter than any run.
    seeds(1, "--hours 0.0000001").refused("too short", &["--hours 0.0000001", "at least --hours"]);
    assert!(!output.join("compare.jsonl").exists());
    for (hours, word) in [("0", "0.5"), ("x", "`x`"), ("nan", "nan"), ("1e9", "1e9")] {
        seeds(1, &format!("--hours {hours}")).refused(hours, &["--hours", word]);
    }
    seeds(1, "--hours 1 --engine slurm").refused("scheduler", &["--hours", "--engine local"]);

    // The longest run is first, and each has its estimate.
    let stdout = seeds(1, "--hours 24").ok().stdout;
    let lines: Vec<&str> = stdout.lines().filter(|line| line.starts_with('[')).collect();
    assert_eq!(lines.len(), 4, "{stdout}");
    assert!(lines[0].contains("320 rows") && lines[3].contains("250 rows"), "{stdout}");
    assert!(lines.iter().all(|line| line.contains("about") && line.contains("left")), "{stdout}");
    for words in ["estimate 4 runs in about", "rough", "fits     ", "320 rows (seed 0)"] {
        assert!(stdout.contains(words), "{words} is not in {stdout}");
    }
    let journal = output.join("compare.jsonl");
    let before = records(&journal);
    assert!(before.iter().all(|run| run["wall_seconds"].as_f64() > Some(0.0)), "{before:?}");

    // What is done is reported, although nothing more fits.
    let stdout = seeds(2, "--hours 0.0000001").ok().stdout;
    for words in ["too long ", "left     ", "seed 1", "PSNR [dB]"] {
        assert!(stdout.contains(words), "{words} is not in {stdout}");
    }
    assert!(!stdout.contains("fits     ") && !stdout.contains("rough"), "{stdout}");
    assert_eq!(records(&journal), before);
    let stdout = seeds(2, "--hours 0.0000001 --engine local").ok().stdout;
    assert!(stdout.contains("left     ") && !stdout.contains("started  "), "{stdout}");
    let stdout = seeds(2, "--hours 24").ok().stdout;
    assert!(stdout.contains("[8/8]") && !stdout.contains("left     "), "{stdout}");
    assert_eq!(records(&journal)[..4], before);
}

#[test]
fn seeds_are_added_until_each_scene_is_decided() {
    let scene = Photographs::colmap_text();
    let (_root, output) = scratch();
    // After two seeds nothing is decided, after four everything.
    let options = "--policies diet,diet:split=random,diet:min_opacity=0.9 -b 320 -i 400";
    let until = |more: &str| {
        let scene = text(scene.path());
        call(&format!("compare {scene} -o {} {options} {more} {FLAGS}", text(&output)))
    };
    let stdout = until("--until-decided --seeds 2 --max-seeds 4").ok().stdout;
    let rule = stdout.find("rule     On each scene").expect("the rule");
    assert!(rule < stdout.find("[1/6]").expect("a first run"), "{stdout}");
    for words in ["2 to begin with, at most 4; a further one", "undecided diet:split=random ("] {
        assert!(stdout.contains(words), "{words} is not in {stdout}");
    }
    let all = records(&output.join("compare.jsonl"));
    let seeds = |policy: &str| all.iter().filter(|run| run["factor"] == policy).count();
    // The first look needs three seeds, the last has four.
    assert!((3..=4).contains(&seeds("diet")), "{stdout}");
    assert_eq!(seeds("diet"), seeds("diet:split=random").max(seeds("diet:min_opacity=0.9")));
    let verdicts = ["better", "worse", "not worse", "mean below −0.1 dB"];
    let decided = |line: &&str| verdicts.iter().any(|verdict| line.contains(verdict));
    assert_eq!(stdout.lines().filter(|line| line.starts_with("diet:")).filter(decided).count(), 2);
    let report = read_text(&output.join("compare.md"));
    for words in ["## Decisions", "from 3 to 4", "## Seeds and views", "| seeds × views |"] {
        assert!(report.contains(words), "{words} is not in {report}");
    }
    // Decisions are final: nothing is trained again.
    let before = files(&output);
    let again = until("--until-decided --seeds 2 --max-seeds 4").ok().stdout;
    assert_eq!(again.matches("done before").count(), all.len(), "{again}");
    assert!(before == files(&output), "a decided comparison was changed");

    let by_mean = until("--until-decided=mean --seeds 2 --max-seeds 4").ok().stdout;
    assert!(by_mean.contains("mean over the scenes"), "{by_mean}");
    for (more, words) in [
        ("--max-seeds 4", &["--until-decided"][..]),
        ("--until-decided --max-seeds 13", &["--max-seeds", "12"]),
        ("--until-decided --seeds 9 --max-seeds 4", &["--seeds", "--max-seeds 4"]),
        ("--until-decided=all", &["--until-decided", "scenes"]),
        ("--until-decided --engine hq", &["--until-decided", "--engine local"]),
    ] {
        until(more).refused(more, words);
    }
    let alone = format!("compare {} --policies diet -b 9 --until-decided", text(scene.path()));
    call(&alone).refused("one policy", &["--until-decided", "two policies"]);
}

#[test]
fn policies_are_compared_under_equal_memory() {
    let scene = Photographs::colmap_text();
    let (_root, output) = scratch();
    let limits = "--memory 40MiB,48MiB -b 300 --seeds 1";
    let stdout = compare(scene.path(), &output, &format!("{limits} {FLAGS}")).ok().stdout;
    let all = records(&output.join("compare.jsonl"));
    assert_eq!(all.len(), 6);
    for run in all.iter().filter(|run| run["spec"].get("budget").is_none()) {
        let memory = count(run, "memory");
        assert_eq!(run["spec"]["memory"], memory);
        assert!(count(run, "ledger_bytes") <= memory, "{run}");
        assert!(count(run, "peak_rows") <= count(run, "budget"), "{run}");
        assert!(count(run, "budget") > 300, "{run}");
    }
    assert!(stdout.contains("40.0 MiB: end"), "{stdout}");
    let report = read_text(&output.join("compare.md"));
    for words in ["### At most 48.0 MiB", ", 300 rows\n", ", 40.0 MiB\n", "quality-memory-"] {
        assert!(report.contains(words), "{words} is not in {report}");
    }
    assert!(output.join("runs").join(all[0]["run"].as_str().unwrap()).is_dir());
    compare(scene.path(), &output, "--memory 1MiB").refused("too little", &["--memory", "MiB"]);
    compare(scene.path(), &output, "--memory 1GiB -- --memory 1GiB")
        .refused("twice", &["--memory"]);
    compare(scene.path(), &output, "--memory 1GiB,1024MiB")
        .refused("equal", &["--memory", "twice"]);
    compare(scene.path(), &output, "").refused("no limit", &["--budget"]);
}

#[test]
fn scores_of_views_and_files_for_others_are_written() {
    let scene = Photographs::colmap_text();
    let (_root, output) = scratch();
    compare(scene.path(), &output, &format!("-b 300 --seeds 2 {FLAGS}")).ok();
    let all = records(&output.join("compare.jsonl"));
    for run in &all {
        let views = run["views"].as_object().expect("views");
        let psnr = views.values().map(|view| view["PSNR"].as_f64().expect("a number"));
        let mean = psnr.sum::<f64>() / views.len() as f64;
        assert!((mean - run["psnr"].as_f64().expect("a number")).abs() < 1e-9, "{run}");
    }
    let label = all[0]["scene"].as_str().expect("a label");
    let table = read_text(&output.join(format!("results/3dgs.zip/{label}.csv")));
    let rows: Vec<&str> = table.lines().collect();
    assert_eq!(rows[0], "Submethod,PSNR,SSIM,LPIPS,Size [Bytes],#Gaussians");
    assert!(rows[1].starts_with("-vanilla-300,") && rows[2].starts_with("-diet-300,"), "{table}");
    for seed in 0..2 {
        let file = format!("results/nerfbaselines/seed{seed}/{label}/diet-300.json");
        let results = json(&output.join(file));
        let run = all.iter().find(|run| run["factor"] == "diet" && run["seed"] == seed);
        let [psnr, expected] = [&results["metrics"]["psnr"], &run.expect("a run")["psnr"]];
        let difference = psnr.as_f64().expect("a number") - expected.as_f64().expect("a number");
        assert!(difference.abs() < 1e-5, "{psnr} {expected}");
        assert_eq!(results["nb_info"]["method"], "densify:diet-300");
    }
}

#[test]
fn two_studies_in_one_folder_are_refused() {
    let scene = Photographs::colmap_text();
    let (_root, output) = scratch();
    let short = |more: &str| compare(scene.path(), &output, &format!("-b 300 {more}"));
    short(&format!("--seeds 1 {FLAGS}")).ok();
    let before = files(&output);
    // Another study would replace the runs.
    short("--seeds 1 -- --sh-degree 1").refused("options", &["--sh-degree", "--output", "runs/"]);
    assert!(before == files(&output), "a refused study changed files");
    let lock = FolderLock::take(&output).expect("a lock");
    short(&format!("--seeds 2 {FLAGS}")).refused("at once", &["in use", "process"]);
    drop(lock);
    assert!(before == files(&output), "a refused study changed files");
    short(&format!("--seeds 2 {FLAGS}")).ok();
    assert_eq!(records(&output.join("compare.jsonl")).len(), 4);
    // Where the earlier runs were moved away, nothing can be lost.
    std::fs::rename(output.join("runs"), output.join("earlier")).expect("an existing folder");
    short("--seeds 1 -- --sh-degree 1").ok();
    assert_eq!(records(&output.join("compare.jsonl")).len(), 6);
}

#[test]
fn a_lost_record_is_found_again_in_the_folder_of_its_run() {
    let scene = Photographs::colmap_text();
    let (_root, output) = scratch();
    let study = || compare(scene.path(), &output, &format!("-b 300 --seeds 1 {FLAGS}"));
    study().ok();
    let journal = output.join("compare.jsonl");
    let whole = read_text(&journal);
    let all = records(&journal);
    // Cut in the middle of the last line, of the first, and removed.
    for kept in [whole.len() - 20, 20, 0] {
        std::fs::write(&journal, &whole[..kept]).expect("written");
        let stdout = study().ok().stdout;
        assert_eq!(stdout.matches("done before").count(), 2, "{stdout}");
        let found = records(&journal);
        assert_eq!(found.len(), 2);
        for key in ["run", "psnr", "views", "model", "spec"] {
            assert_eq!(found[1][key], all[1][key], "{key}");
        }
    }
    // A line in the middle cannot be read: the message names it.
    std::fs::write(&journal, whole.replacen("{\"densify\"", "{\"den", 1)).expect("written");
    study().refused("damaged", &["compare.jsonl, line 1", "delete the line"]);
    // A folder that does not hold this run is not taken for it.
    std::fs::remove_file(&journal).expect("an existing file");
    let folder = output.join("runs").join(all[0]["run"].as_str().expect("a name"));
    let config = read_text(&folder.join("config.toml"));
    let other = config.replace("iterations = 24", "iterations = 23");
    assert_ne!(config, other);
    std::fs::write(folder.join("config.toml"), other).expect("written");
    let stdout = study().ok().stdout;
    assert_eq!(stdout.matches("done before").count(), 1, "{stdout}");
    assert_eq!(records(&journal).len(), 2);
}

/// Calls the program in a shell after a command that limits it.
#[cfg(unix)]
fn call_after(limit: &str, words: &str) -> Outcome {
    let program = env!("CARGO_BIN_EXE_densify");
    let mut command = Command::new("sh");
    command.args(["-c", &format!("{limit}; exec {program} {words}")]);
    command.env_remove("RUST_LOG").env("NODEVICE_SELECT", "1").envs([super::WITHOUT_GPU]);
    outcome_of(command)
}

#[cfg(unix)]
#[test]
fn too_little_memory_a_full_disk_and_a_failing_scene_lose_no_finished_run() {
    let scene = Photographs::colmap_text();
    let (_root, output) = scratch();
    let study = |more: &str| words(scene.path(), &output, &format!("{more} {FLAGS} --threads 1"));
    // 20 million rows take more than 4 GB; the system grants 4 GB of addresses.
    let wrong = call_after("ulimit -v 4000000", &study("-b 300,20M --seeds 1"));
    wrong.refused("memory", &["20,000,000 rows", "--budget", "no run was started"]);
    assert!(!output.join("compare.jsonl").exists());

    call(&study("-b 300 --seeds 1")).ok();
    let journal = read_text(&output.join("compare.jsonl"));
    // To a writer this looks like a full disk, for which the exit code is 1 everywhere.
    let full = call_after("trap '' XFSZ; ulimit -f 4", &study("-b 300 --seeds 2"));
    assert_eq!(full.code, Some(1), "{full:?}");
    assert_eq!(full.stderr.matches("error:").count(), 1, "{full:?}");
    for word in ["cannot write", "make room", "seed 1", "resumes here"] {
        assert!(full.stderr.contains(word), "{word} is not in {}", full.stderr);
    }
    assert_eq!(read_text(&output.join("compare.jsonl")), journal);

    // A photograph that cannot be decoded is found while the run trains.
    let other = Photographs::transforms();
    let photograph = "train/r_1.png";
    let bytes = super::read(&other.file(photograph));
    other.truncate(photograph, bytes.len() / 2);
    let both = format!("{} {}", text(scene.path()), text(other.path()));
    let words = study("-b 300 --seeds 2").replacen(text(scene.path()), &both, 1);
    call(&words).refused("photograph", &[photograph, "this was the run"]);
    let kept = read_text(&output.join("compare.jsonl"));
    assert!(kept.starts_with(&journal), "{kept}");
    // Once it is repaired, the same command goes on.
    std::fs::write(other.file(photograph), bytes).expect("written");
    let stdout = call(&words).ok().stdout;
    assert!(stdout.contains("[8/8]") && stdout.contains("done before"), "{stdout}");
}
