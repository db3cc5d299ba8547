//! `densify compare`: policies under equal conditions.

use std::path::Path;

use super::{densify, files, read, records, scratch, text};
use crate::photographs::Photographs;

/// Two policies, two budgets, two seeds, in runs of some dozen steps.
fn compare(scene: &Path, output: &Path, more: &[&str]) -> super::Outcome {
    let mut arguments = vec!["compare", text(scene), "-o", text(output), "--seeds", "2"];
    arguments.extend(["--policies", "vanilla,diet", "--budget", "250,320", "--iterations", "24"]);
    arguments.extend(more);
    densify(&arguments)
}

#[test]
fn every_run_is_there_once_and_in_the_table() {
    let scene = Photographs::colmap_text();
    let (_root, output) = scratch();
    let said = compare(scene.path(), &output, &["--", "--sh-degree", "0"]).ok().stdout;
    assert!(said.contains("[8/8]") && said.contains("PSNR [dB]"), "{said}");
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
    // Seeds differ, and so do budgets; nothing else was varied.
    let psnr = |i: usize| all[i]["psnr"].as_f64().expect("a number");
    assert_ne!(psnr(0).to_bits(), psnr(4).to_bits(), "the seeds do nothing");
    let table = String::from_utf8(read(&output.join("compare.md"))).expect("UTF-8");
    for word in ["| vanilla |", "| diet |", "250 rows", "320 rows", " of 4 |"] {
        assert!(table.contains(word), "{word} is not in {table}");
    }
    assert!(!table.contains("Chamfer") && all.iter().all(|r| r.get("geometry").is_none()));
    // Every picture that the table shows is there.
    let pictures: Vec<&str> =
        table.split("](").skip(1).filter_map(|rest| rest.split(')').next()).collect();
    assert_eq!(pictures.len(), 5, "{pictures:?}");
    for picture in pictures {
        let bytes = read(&output.join(picture));
        assert!(bytes.starts_with(b"<svg") || bytes.starts_with(b"\x89PNG"), "{picture}");
    }

    // Again: nothing runs, and nothing changes.
    let before = files(&output);
    let said = compare(scene.path(), &output, &["--", "--sh-degree", "0"]).ok().stdout;
    assert_eq!(said.matches("done before").count(), 8, "{said}");
    assert!(before == files(&output), "a comparison that was complete has changed");

    // A record that was lost, or cut off: its run runs again, to the same end.
    let log = output.join("compare.jsonl");
    let lines = String::from_utf8(read(&log)).expect("UTF-8");
    let kept: Vec<&str> = lines.lines().take(7).collect();
    std::fs::write(&log, kept.join("\n") + "\n{\"densify\":").expect("it is written");
    let said = compare(scene.path(), &output, &["--", "--sh-degree", "0"]).ok().stdout;
    assert_eq!(said.matches("done before").count(), 7, "{said}");
    assert_eq!(records(&log)[7]["psnr"], all[7]["psnr"]);
}

#[test]
fn a_policy_competes_with_itself_by_its_parameters() {
    let scene = Photographs::colmap_text();
    let (_root, output) = scratch();
    let call = ["compare", text(scene.path()), "-o", text(&output), "--seeds", "1"];
    let variant = "diet:min_opacity=0.5:rho=0";
    let policies = format!("diet,{variant}");
    let more = ["--policies", &policies, "--budget", "320", "--iterations", "400"];
    densify(&[&call[..], &more].concat()).ok();
    let all = records(&output.join("compare.jsonl"));
    assert_eq!([&all[0]["factor"], &all[1]["factor"]], ["diet", variant]);
    assert_ne!(all[0]["psnr"], all[1]["psnr"], "the parameters do nothing");
    let run = all[1]["run"].as_str().expect("a name");
    assert!(
        run.ends_with("diet-min_opacity-0.5-rho-0-320-seed0")
            && output.join("runs").join(run).is_dir()
    );
    let table = String::from_utf8(read(&output.join("compare.md"))).expect("UTF-8");
    assert!(table.contains(&format!("| {variant} |")), "{table}");
}

#[test]
fn bad_comparisons_are_refused_before_anything_runs() {
    let scene = Photographs::colmap_text();
    let (root, output) = scratch();
    let nowhere = root.path().join("nowhere");
    let cases: [(&str, &[&str], &[&str]); 5] = [
        ("its own option", &["--", "--seed", "3"], &["--seed", "study"]),
        ("zero seeds", &["--seeds", "0"], &["--seeds"]),
        ("two scenes of one name", &[text(scene.path())], &["two scenes"]),
        ("no scene", &[text(&nowhere)], &["nowhere", "folder"]),
        ("an option that train lacks", &["--", "--sh-degre", "3"], &["--sh-degre"]),
    ];
    for (case, more, words) in cases {
        if case == "zero seeds" {
            let arguments = ["compare", text(scene.path()), "--policies", "diet", "-b", "9"];
            densify(&[&arguments[..], more].concat()).refused(case, words);
        } else {
            compare(scene.path(), &output, more).refused(case, words);
        }
    }
    let policies = |names: &str| {
        densify(&[
            "compare",
            text(scene.path()),
            "--policies",
            names,
            "-b",
            "300",
            "-o",
            text(&output),
        ])
    };
    policies("diet,dite").refused("unknown policy", &["dite", "diet"]);
    policies("diet,diet:rhoo=0").refused("unknown parameter", &["rhoo", "diet"]);
    policies("diet,diet:rho").refused("no value", &["--policies", "diet.rho"]);
    policies("diet,diet").refused("twice", &["--policies", "diet", "twice"]);
    assert!(!output.join("compare.md").exists());
}
