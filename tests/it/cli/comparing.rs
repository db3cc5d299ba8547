//! `densify compare`: trains several policies under equal conditions.

use std::path::Path;

use densify_policies::registry::policies;
use serde_json::{Value, json};

use super::{Outcome, call, files, read, read_text, records, scratch, text};
#[cfg(unix)]
use super::{call_with_path, run_array_task, write_program};
use crate::photographs::Photographs;

/// Compares two policies with two budgets and two seeds in short runs.
fn compare(scene: &Path, output: &Path, more: &str) -> Outcome {
    call(&compare_words(scene, output, more))
}

fn compare_words(scene: &Path, output: &Path, more: &str) -> String {
    let options = "--seeds 2 --policies vanilla,diet --budget 250,320 --iterations 24";
    format!("compare {} -o {} {options} {more}", text(scene), text(output))
}

#[test]
fn every_run_appears_once_in_the_log_and_the_table() {
    let scene = Photographs::colmap_text();
    let (_root, output) = scratch();
    let stdout = compare(scene.path(), &output, "-- --sh-degree 0").ok().stdout;
    assert!(stdout.contains("[8/8]") && stdout.contains("PSNR [dB]"), "{stdout}");
    let all = records(&output.join("compare.jsonl"));
    assert_eq!(all.len(), 8);
    for record in &all {
        assert!(record["peak_rows"].as_u64() <= record["budget"].as_u64(), "{record}");
        assert!(record["psnr"].as_f64() > Some(5.0), "{record}");
        let flip = record["flip"].as_f64().expect("a number");
        assert!(flip > 0.0 && flip < 0.9, "{record}");
        assert_eq!(record["curve"].as_array().map(Vec::len), Some(8), "{record}");
        assert_eq!(record["spec"]["sh_degree"], 0, "{record}");
    }
    // Different seeds give different results.
    let psnr = |i: usize| all[i]["psnr"].as_f64().expect("a number");
    assert_ne!(psnr(0).to_bits(), psnr(4).to_bits(), "the seeds have no effect");
    let table = read_text(&output.join("compare.md"));
    for word in [
        "| vanilla |",
        "| diet |",
        "250 rows",
        ", two seeds",
        " of 4 |",
        "\nsh_degree = 0\n",
        "\ninit_rates = \"fine\"\n",
    ] {
        assert!(table.contains(word), "{word} is not in {table}");
    }
    assert!(!table.contains("Chamfer") && all.iter().all(|r| r.get("geometry").is_none()));
    // Every picture in the table exists.
    let pictures: Vec<&str> =
        table.split("](").skip(1).filter_map(|rest| rest.split(')').next()).collect();
    assert_eq!(pictures.len(), 5, "{pictures:?}");
    for picture in pictures {
        let bytes = read(&output.join(picture));
        assert!(bytes.starts_with(b"<svg") || bytes.starts_with(b"\x89PNG"), "{picture}");
    }
    // The HTML report is a single file.
    let page = read_text(&output.join("compare.html"));
    super::reporting::assert_self_contained(&page);
    assert_eq!(page.matches("src=\"data:image/").count(), 5);
    assert!(
        page.contains("<td>vanilla</td>") && page.contains("init_rates = &quot;fine&quot;"),
        "{page}"
    );

    // Repeating the call trains nothing and changes no file.
    let before = files(&output);
    let stdout = compare(scene.path(), &output, "-- --sh-degree 0").ok().stdout;
    assert_eq!(stdout.matches("done before").count(), 8, "{stdout}");
    assert!(before == files(&output), "a complete comparison was changed");

    // If a record is lost or truncated, and its run too, only that run is repeated, with the same result.
    let log = output.join("compare.jsonl");
    let lines = read_text(&log);
    let kept: Vec<&str> = lines.lines().take(7).collect();
    std::fs::write(&log, kept.join("\n") + "\n{\"densify\":").expect("written");
    let lost = all[7]["run"].as_str().expect("a name");
    std::fs::remove_dir_all(output.join("runs").join(lost)).expect("an existing folder");
    // A run with damaged records has no curves, and the output says so.
    let run = all[0]["run"].as_str().expect("a name");
    std::fs::write(output.join("runs").join(run).join("stats/train.jsonl"), "{\n")
        .expect("written");
    let stdout = compare(scene.path(), &output, "-- --sh-degree 0").ok().stdout;
    assert!(stdout.contains("train.jsonl: line 1: ") && stdout.contains("left out"), "{stdout}");
    assert_eq!(stdout.matches("done before").count(), 7, "{stdout}");
    assert_eq!(records(&log)[7]["psnr"], all[7]["psnr"]);
}

#[test]
fn a_policy_can_be_compared_under_different_parameters() {
    let scene = Photographs::colmap_text();
    let (_root, output) = scratch();
    let variant = "diet:min_opacity=0.5:rho=0";
    let options = format!("--seeds 1 --policies diet,{variant} --budget 320 --iterations 400");
    call(&format!("compare {} -o {} {options}", text(scene.path()), text(&output))).ok();
    let all = records(&output.join("compare.jsonl"));
    assert_eq!([&all[0]["factor"], &all[1]["factor"]], ["diet", variant]);
    assert_ne!(all[0]["psnr"], all[1]["psnr"], "the parameters have no effect");
    let run = all[1]["run"].as_str().expect("a name");
    assert!(run.ends_with("diet-min_opacity-0.5-rho-0-320-seed0"), "{run}");
    assert!(output.join("runs").join(run).is_dir());
    let table = read_text(&output.join("compare.md"));
    assert!(table.contains(&format!("| {variant} |")), "{table}");
}

#[test]
fn all_policies_are_run_and_ranked() {
    let scene = Photographs::colmap_text();
    let (_root, output) = scratch();
    let options = "--seeds 1 --policies vanilla,all --budget 320 --iterations 24";
    let stdout =
        call(&format!("compare {} -o {} {options}", text(scene.path()), text(&output))).ok().stdout;
    let registered = policies().expect("the registry is sound");
    let others = registered.iter().map(|entry| entry.name).filter(|name| *name != "vanilla");
    let names: Vec<&str> = std::iter::once("vanilla").chain(others).collect();
    let all = records(&output.join("compare.jsonl"));
    let ran: Vec<&str> = all.iter().filter_map(|record| record["factor"].as_str()).collect();
    assert_eq!(ran, names);
    let table = read_text(&output.join("compare.md"));
    for name in names {
        // The first table has RANK NAME PSNR …, the second NAME END PEAK.
        let words = |line: &str| line.split_whitespace().map(String::from).collect::<Vec<_>>();
        let has = |at: usize, other: usize| {
            stdout.lines().map(words).any(|row| {
                row.get(at).is_some_and(|word| word == name)
                    && row.get(other).is_some_and(|word| word.parse::<usize>().is_ok())
            })
        };
        assert!(has(1, 0) && has(0, 2), "{name}: {stdout}");
        assert!(table.contains(&format!("| {name} |")), "{name}: {table}");
    }
    assert!(stdout.contains("vs vanilla") && stdout.contains("320 rows: end"), "{stdout}");
    assert!(table.contains("### At most 320 rows\n"), "{table}");
}

#[test]
fn invalid_comparisons_are_refused_before_any_run() {
    let scene = Photographs::colmap_text();
    let (root, output) = scratch();
    let nowhere = root.path().join("nowhere");
    let cases: [(&str, &[&str]); 4] = [
        ("-- --seed 3", &["--seed", "study"]),
        (text(scene.path()), &["two scenes"]),
        (text(&nowhere), &["nowhere", "folder"]),
        ("-- --sh-degre 3", &["--sh-degre"]),
    ];
    for (more, words) in cases {
        compare(scene.path(), &output, more).refused(more, words);
    }
    // `src/tools/study/compare/policy_variant.rs` defines the syntax of policies with parameters.
    for (policies, words) in [
        ("diet,dite", ["dite", "diet"]),
        ("diet,diet:rho", ["--policies", "diet.rho"]),
        ("diet,diet", ["--policies", "twice"]),
        ("all,diet,all", ["--policies", "all twice"]),
        ("diet --seeds 0", ["--seeds", "0"]),
    ] {
        let (scene, output) = (text(scene.path()), text(&output));
        call(&format!("compare {scene} --policies {policies} -b 300 -o {output}"))
            .refused(policies, &words);
    }
    assert!(!output.join("compare.md").exists());
}

/// Name, model and PSNR of every run, in an order that does not depend on the engine.
fn results(folder: &Path) -> Vec<Value> {
    let records = records(&folder.join("compare.jsonl"));
    let mut results: Vec<Value> =
        records.iter().map(|r| json!([r["run"], r["model"], r["psnr"]])).collect();
    results.sort_by_key(ToString::to_string);
    results
}

/// The first call submits the runs to a scheduler; repeating it collects the results. `sbatch` is a stand-in that does
/// nothing; the test then runs the script itself.
#[cfg(unix)]
#[test]
fn scheduler_runs_match_local_ones_and_are_collected_by_repeating_the_call() {
    let scene = Photographs::colmap_text();
    let (root, alone) = scratch();
    let flags = "-- --sh-degree 0 --threads 1";
    compare(scene.path(), &alone, flags).ok();
    let output = root.path().join("submitted");
    let bin = root.path().join("bin");
    std::fs::create_dir(&bin).expect("a folder");
    let path = format!("{}:{}", text(&bin), std::env::var("PATH").expect("a path"));
    let submit = |more: &str, path: &str| {
        let words = compare_words(scene.path(), &output, &format!("--engine slurm {more} {flags}"));
        call_with_path(&words, path)
    };
    let shown = submit("--dry-run", text(&bin)).ok().stdout;
    assert!(shown.contains("0 of 8 done") && !output.exists(), "{shown}");
    submit("", text(&bin)).refused("no Slurm", &["sbatch", "PATH"]);
    assert!(!output.exists(), "a refused submission left files");
    write_program(&bin, "scontrol", "echo; echo 'MaxArraySize            = 3'");
    let shown_in_parts = submit("--dry-run", &path).ok().stdout;
    for (name, tasks) in [("", "0,1,2"), ("-2", "0,1,2"), ("-3", "0,1")] {
        assert!(shown_in_parts.contains(&format!("slurm/runs{name}.sh\n")), "{shown_in_parts}");
        let header = format!("--job-name=densify-runs{name}\n");
        let script = shown_in_parts.split(&header).nth(1).expect("a script");
        assert!(script.split("names=").next().unwrap().contains(&format!("--array={tasks}\n")));
    }
    // Jobs that were submitted before the scheduler refused one find the descriptions of their runs.
    write_program(&bin, "sbatch", "[ ! -e \"$0.ran\" ] || exit 1; touch \"$0.ran\"; echo 6");
    submit("", &path).refused("one array submitted", &["already submitted: 6", "scancel"]);
    let described = files(&output).into_keys().filter(|name| name.ends_with(".task.toml"));
    assert_eq!(described.count(), 8);
    std::fs::remove_dir_all(&output).expect("an existing folder");
    std::fs::remove_file(bin.join("scontrol")).expect("an existing file");
    write_program(&bin, "sbatch", "echo 7");
    let stdout = submit("", &path).ok().stdout;
    assert!(stdout.contains("job      7") && stdout.contains("again to collect"), "{stdout}");
    let script = output.join("slurm/runs.sh");
    let text_of_script = read_text(&script);
    // The memory includes what the process measures of itself, which varies.
    let without_memory = |text: &str| {
        text.lines()
            .filter(|line| !line.starts_with("#SBATCH --mem="))
            .collect::<Vec<_>>()
            .join("\n")
    };
    assert!(without_memory(&shown).contains(&without_memory(&text_of_script)), "{shown}");
    assert!(text_of_script.contains("#SBATCH --array=0,1,2,3,4,5,6,7\n"), "{text_of_script}");
    assert!(text_of_script.contains("#SBATCH --cpus-per-task=1\n"), "{text_of_script}");
    for index in ["3", "0", "1", "2", "4", "5", "6"] {
        run_array_task(&script, index);
    }
    let stdout = submit("", &path).ok().stdout;
    assert!(stdout.contains("7 of 8 done") && stdout.contains("as job 7"), "{stdout}");
    assert!(!output.join("compare.md").exists());
    // Only unfinished runs are submitted again.
    submit("--again", &path).ok();
    assert!(read_text(&script).contains("#SBATCH --array=7\n"));
    run_array_task(&script, "7");
    let stdout = submit("", &path).ok().stdout;
    assert!(stdout.contains("[8/8]") && stdout.contains("PSNR [dB]"), "{stdout}");
    assert!(read_text(&output.join("compare.md")).contains("| diet |"));
    assert_eq!(results(&output), results(&alone));

    // A run with other options does not count as done, even if a folder has its name.
    let other = compare_words(
        scene.path(),
        &output,
        "--engine slurm --dry-run -- --sh-degree 1 --threads 1",
    );
    assert!(call(&other).ok().stdout.contains("0 of 8 done"));
    compare(scene.path(), &output, "--again -- --sh-degree 0")
        .refused("no engine", &["--again", "--engine"]);
}

#[test]
fn parallel_runs_match_sequential_ones() {
    let scene = Photographs::colmap_text();
    let (root, alone) = scratch();
    let flags = "-- --sh-degree 0 --threads 1";
    compare(scene.path(), &alone, flags).ok();
    let output = root.path().join("at-once");
    let stdout = compare(scene.path(), &output, &format!("--engine local {flags}")).ok().stdout;
    assert!(stdout.contains("started  ") && stdout.contains("[8/8]"), "{stdout}");
    assert_eq!(results(&output), results(&alone));
    // A failed run is named with its error message.
    let blocked = root.path().join("blocked");
    let run = results(&alone)[0][0].as_str().expect("a name").to_owned();
    std::fs::create_dir_all(blocked.join("runs")).expect("a folder");
    std::fs::write(blocked.join("runs").join(&run), "").expect("written");
    let wrong = compare(scene.path(), &blocked, &format!("--engine local {flags}"));
    wrong.refused("a file in the way", &[&run, "is not a folder"]);
    let wrong = compare(scene.path(), &root.path().join("small"), "-- --memory 1MiB");
    wrong.refused("too little memory", &["--memory"]);
}
