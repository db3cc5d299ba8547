//! `--memory` and `densify plan`: what is promised is kept, plan and train agree, and what fits no
//! model is refused with what would.

use std::path::Path;

use densify_policies::registry::{find, policies};

use super::{
    Outcome, WITHOUT_GPU, call, config, copy_unfinished, count, densify, files, json, model, often,
    records, scratch, text,
};
use crate::photographs::Photographs;

const MIB: u64 = 1 << 20;

fn plan(scene: &Path, flags: &str) -> Outcome {
    call(&format!("plan {} --backend cpu {flags}", text(scene)))
}

fn train(scene: &Path, run: &Path, flags: &str) -> Outcome {
    call(&format!("train {} -o {} --backend cpu {flags}", text(scene), text(run)))
}

/// The ledger in what was said.
fn ledger(outcome: &Outcome) -> &str {
    let start = outcome.stdout.find("memory promised").expect("a ledger");
    let table = &outcome.stdout[start..];
    let total = table.find("\n  total").expect("its total");
    let end = table[total + 1..].find('\n').map_or(table.len(), |end| total + 1 + end);
    &table[..end]
}

/// The line that says how many rows there may be.
fn budget(outcome: &Outcome) -> &str {
    let mut lines = outcome.stdout.lines();
    lines.find(|line| line.starts_with("budget ")).expect("a budget")
}

#[test]
fn plan_says_what_train_promises_and_writes_nothing() {
    let scene = Photographs::colmap_text();
    let mut cases = vec![
        "--memory 48MiB --eval".to_owned(),
        "--memory 64MiB --sh-degree 1 --tile-cap 90k --image-cache 10kB -r 2".to_owned(),
        "--memory 256MiB --budget 3k --init random --threads 1".to_owned(),
        "--budget 700 --test-every 5 --init-points 50".to_owned(),
        String::new(),
    ];
    let all = policies().expect("the registry is sound");
    cases.extend(all.iter().map(|entry| format!("--policy {} --memory 80MiB --eval", entry.name)));
    for flags in cases {
        let (root, run) = scratch();
        let flags = format!("{flags} --iterations 2");
        let planned = plan(scene.path(), &format!("-o {} {flags}", text(&run))).ok();
        assert!(files(root.path()).is_empty(), "{flags}: {:?}", files(root.path()).keys());
        let trained = train(scene.path(), &run, &format!("{flags} -v")).ok();
        assert_eq!(ledger(&planned), ledger(&trained), "{flags}");
        let tenths = |line: &str| -> u64 {
            let size = line.trim_end().trim_end_matches(" MiB").rsplit(' ').next().expect("a size");
            size.replace([',', '.'], "").parse().unwrap_or_else(|e| panic!("{line}: {e}"))
        };
        let lines: Vec<&str> =
            ledger(&planned).lines().skip(1).filter(|it| !it.ends_with(')')).collect();
        let (total, lines) = lines.split_last().expect("a total");
        assert_eq!(lines.iter().map(|line| tenths(line)).sum::<u64>(), tenths(total), "{flags}");
        let left = planned.stdout.contains("of --memory\n");
        assert_eq!(left, flags.contains("--memory"), "{flags}: {}", planned.stdout);
        assert_eq!(budget(&planned), budget(&trained), "{flags}");
        let summary = json(&run.join("stats/summary.json"));
        let rows = format!("budget   {}", grouped(count(&summary, "budget")));
        assert!(budget(&planned).starts_with(&rows), "{flags}: {}", budget(&planned));
        for said in ["Gaussians that --memory", "-r 1 (48x40)", "-r 4 (12x10)", "degree 3"] {
            assert!(planned.stdout.contains(said), "{flags}: {said:?} in {}", planned.stdout);
        }
    }
}

fn grouped(number: u64) -> String {
    match (number / 1000, number % 1000) {
        (0, rest) => rest.to_string(),
        (thousands, rest) => format!("{},{rest:03}", grouped(thousands)),
    }
}

#[test]
fn a_run_takes_no_more_than_it_is_given() {
    let scene = Photographs::transforms();
    for (memory, policy, preset, points) in [
        (48, "diet", "exact", "17k"),
        (64, "taming", "exact", "30k"),
        (64, "mcmc", "exact", "100k"),
        // Here the model as f32 would be half of what is promised.
        (256, "diet", "tiny-memory", "245k"),
    ] {
        let (_root, run) = scratch();
        // Every row is there from the start, and edits come, so that all of the promise is needed.
        let often = often(find(policy).expect("it is registered"));
        let flags = format!("--policy {policy} {often} --preset {preset} --init-points {points}");
        let flags = format!("{flags} --memory {memory}MiB --eval --iterations 12");
        train(scene.path(), &run, &format!("{flags} --test-iterations 3 --checkpoint-every 5"))
            .ok();
        let summary = json(&run.join("stats/summary.json"));
        let (budget, promised) = (count(&summary, "budget"), count(&summary, "ledger_bytes"));
        assert_eq!(count(&summary, "memory"), memory * MIB, "{flags}");
        assert!(promised <= memory * MIB, "{flags}: {promised} promised");
        // As many as fit: a tenth more would not.
        assert!(
            budget > 5_000 && promised > memory * MIB * 9 / 10,
            "{flags}: {budget}, {promised}"
        );
        assert!(count(&summary, "peak_rows") > budget / 2, "{flags}: {summary}");
        if let Some(peak) = summary["peak_bytes"].as_u64() {
            assert!(peak <= memory * MIB, "{flags}: a peak of {peak}");
            assert!(peak * 100 <= promised * 105, "{flags}: a peak of {peak}, {promised} promised");
            let log = records(&run.join("stats/train.jsonl"));
            let resident = count(&log[log.len() - 1], "resident_bytes");
            assert!(resident > MIB && resident <= peak, "{flags}: {resident} of {peak}");
        }
    }
}

/// All that grows with the rows: what lasts, and what an event of the policy takes beside it.
#[test]
fn a_row_takes_no_more_than_480_bytes_in_tiny_memory() {
    let scene = Photographs::colmap_text();
    for policy in ["vanilla", "diet", "mcmc"] {
        let [less, more] = ["256MiB", "512MiB"].map(|memory| {
            let flags = format!("--policy {policy} --preset tiny-memory --sh-degree 3");
            let planned = plan(scene.path(), &format!("{flags} --memory {memory}")).ok();
            let rows = budget(&planned).trim_start_matches("budget").trim_start();
            let rows: String =
                rows.chars().take_while(|c| *c != ' ').filter(|c| *c != ',').collect();
            rows.parse::<u64>().expect("a number of rows")
        });
        let bytes = 256.0 * MIB as f64 / (more - less) as f64;
        assert!(bytes > 300.0 && bytes <= 480.0, "{policy}: {bytes} bytes, {less} and {more} rows");
    }
}

#[test]
fn on_a_gpu_it_bounds_what_is_on_the_device() {
    let scene = Photographs::colmap_text();
    let mut rows: Vec<(&str, u64)> = Vec::new();
    for device in crate::subject::ways() {
        let (root, run) = scratch();
        let name = &device.adapter().name;
        let knob = format!("accumulation={}", device.accumulation());
        let flags =
            ["--gpu", name, "--memory", "48MiB", "--iterations", "2", "--eval", "--knob", &knob];
        let call = |command: &str| {
            let arguments = [command, text(scene.path()), "-o", text(&run)];
            densify(&[&arguments[..], &flags].concat())
        };
        let planned = call("plan").ok();
        assert!(files(root.path()).is_empty(), "{name}");
        let trained = call("train").ok();
        assert_eq!(budget(&planned), budget(&trained), "{name}");
        let summary = json(&run.join("stats/summary.json"));
        let lines = summary["ledger"]["lines"].as_array().expect("lines");
        let on_device = lines.iter().filter(|line| line["on_device"] == true);
        let bytes: u64 = on_device.map(|line| count(line, "bytes")).sum();
        // What the backend allocates is the ledger: `what_is_allocated_is_what_the_ledger_says`.
        assert!(bytes <= 48 * MIB && bytes > 47 * MIB, "{name}: {bytes}");
        assert!(planned.stdout.contains("on the device"), "{name}: {}", planned.stdout);
        // Without records more rows fit.
        let most = count(&summary, "budget");
        let in_slots = rows.iter().find(|(other, _)| other == name).map(|(_, rows)| *rows);
        let is_in_slots = device.accumulation().is_deterministic();
        assert!(is_in_slots || in_slots.is_some_and(|rows| most > rows + rows / 10), "{name}");
        rows.push((name, most));
    }
}

#[test]
fn the_smaller_of_two_limits_holds() {
    let scene = Photographs::colmap_text();
    let plan = |flags: &str| plan(scene.path(), flags).ok();
    let by_budget = plan("--budget 500 --memory 1GiB");
    assert!(budget(&by_budget).ends_with("500 rows: --memory 1.0 GiB would hold as many or more"));
    let by_memory = plan("--budget 3M --memory 64MiB");
    assert!(budget(&by_memory).ends_with("holds fewer than --budget 3,000,000"));
    assert_eq!(budget(&plan("--memory 64MiB")), budget(&plan("--memory 64MiB --threads 5")));
    // The degree is lowered for the points of the scene only.
    assert!(plan("--memory 40MiB").stdout.contains("degree 3,"));
    let lowered = plan("--memory 64MiB --init-points 45k").stdout;
    assert!(!lowered.contains("degree 3,") && lowered.contains("instead of 3"), "{lowered}");
    let kept = plan("--memory 64MiB --init-points 45k --sh-degree 3").stdout;
    assert!(kept.contains("degree 3,") && !kept.contains("instead"), "{kept}");
}

/// The remedies of a refusal, in their order.
fn remedies(outcome: &Outcome) -> Vec<String> {
    let told = outcome.stderr.split("; give ").nth(1).expect("a remedy").trim();
    told.split(", or ").map(str::to_owned).collect()
}

/// The flags of a call after a remedy: `--flag value` is new or in place of another, `no --flag` is gone.
fn followed(flags: &str, remedy: &str) -> String {
    let mut all: Vec<(&str, &str)> = Vec::new();
    let mut words = flags.split_whitespace().chain(remedy.split_whitespace());
    while let Some(word) = words.next() {
        let value = words.next().expect("a value");
        let flag = if word == "no" { value } else { word };
        all.retain(|(other, _)| *other != flag);
        if word != "no" {
            all.push((flag, value));
        }
    }
    all.iter().map(|(flag, value)| format!("{flag} {value} ")).collect()
}

#[test]
fn a_memory_that_holds_no_model_is_refused_with_what_fits_and_the_cheapest_comes_first() {
    let scene = Photographs::colmap_text();
    let plan = |flags: &str| plan(scene.path(), flags);
    // Photographs cost only time to decode again.
    for (flags, second) in [
        ("", "--preset tiny-memory"),
        ("--test-every 5 --sh-degree 3", "--preset tiny-memory"),
        ("--tile-cap 100k", "no --tile-cap"),
        ("--policy taming --image-cache 1MiB", "--preset tiny-memory"),
        ("--policy taming --preset tiny-memory", "-r 2"),
    ] {
        let (root, run) = scratch();
        let outcome = train(scene.path(), &run, &format!("--memory 1MiB {flags}"));
        outcome.refused(flags, &["--memory 1.0 MiB", "1,000 rows", "give --memory"]);
        assert!(files(root.path()).is_empty(), "{flags}");
        let [least] = &remedies(&outcome)[..] else { panic!("the program takes more") };
        plan(&followed(flags, least)).ok();
        let mib = least.trim_start_matches("--memory ").trim_end_matches("MiB");
        let mib: u64 = mib.parse().unwrap_or_else(|e| panic!("{least}: {e}"));
        // The most that is too little, to the kibibyte: what is missing is little, whatever a step holds.
        let (mut little, mut enough) = ((mib - 1) << 10, mib << 10);
        while enough - little > 1 {
            let middle = (little + enough) / 2;
            let fits = plan(&format!("--memory {middle}KiB {flags}")).code == Some(0);
            *(if fits { &mut enough } else { &mut little }) = middle;
        }
        let flags = format!("--memory {little}KiB {flags}");
        let outcome = plan(&flags);
        outcome.refused(&flags, &[least]);
        let all = remedies(&outcome);
        assert_eq!(all[..2], ["--image-cache 0", second], "{flags}: {all:?}");
        for remedy in all {
            plan(&followed(&flags, &remedy)).ok();
        }
    }
    let refused = |flags: &str, words| plan(flags).refused(flags, words);
    refused("--memory 0", &["--memory 0 B"]);
    refused("--memory plenty", &["--memory", "plenty", "512MiB"]);
    refused("--resume", &["--resume"]);
}

/// Without `--memory` the table is of what was planned, in whole mebibytes.
#[test]
fn what_the_table_says_a_memory_holds_it_holds() {
    let photographs = Photographs::colmap_text();
    let (photographs, known) = (photographs.path(), Path::new("scene:spheres"));
    // Rendering a scene for the first time leaves the process larger.
    plan(known, "").ok();
    for (scene, flags) in [
        (photographs, "--budget 20k"),
        (photographs, "--budget 20k --preset tiny-memory --policy taming"),
        (photographs, ""),
        // Measuring the geometry takes more than training.
        (known, "--budget 20k --preset tiny-memory --eval"),
    ] {
        let planned = plan(scene, flags).ok();
        let said = planned.stdout.split("Gaussians that --memory ").nth(1).expect("a table");
        let (memory, table) = said.split_once("MiB").expect("a size");
        let row = table.lines().find(|line| line.starts_with("  degree 3")).expect("a row");
        let rows = row.split_whitespace().nth(2).expect("rows at full size");
        let flags = flags.replace("--budget 20k", "") + &format!(" --memory {memory}MiB");
        let again = plan(scene, &flags).ok();
        assert!(budget(&again).starts_with(&format!("budget   {rows} rows")), "{rows}: {again:?}");
        let number: usize = rows.replace(',', "").parse().expect("a number");
        assert!(number >= 20_000, "{flags}: {number}");
    }
}

#[test]
fn a_run_for_a_memory_goes_on_with_what_was_chosen() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    let flags = "--iterations 6 --checkpoint-every 3";
    train(scene.path(), &run, &format!("--memory 48MiB {flags}")).ok();
    let before = files(&run);
    let config = config(&run);
    let chosen = |key: &str| config[key].as_integer();
    assert_eq!(chosen("memory"), Some(48 << 20));
    let rows = chosen("budget").expect("a budget");
    assert_eq!(chosen("tile_cap"), Some(4 * rows));
    assert!(chosen("image_cache").is_some());
    for (flags, words) in [
        ("--memory 49MiB", ["--memory: 51380224 now", "50331648 in that run"]),
        ("--budget 300", ["--budget: 300 now", "in that run"]),
        ("--sh-degree 2", ["--sh-degree: 2 now", "3 in that run"]),
        // It changes no byte of the result, but is more than was allowed.
        ("--tile-cap 10M", ["--memory 48.0 MiB", "give --tile-cap"]),
    ] {
        train(scene.path(), &run, &format!("--resume {flags}")).refused(flags, &words);
        assert!(files(&run) == before, "{flags} touched the run");
    }
    let part = root.path().join("part");
    copy_unfinished(&run, &part, 6);
    train(scene.path(), &part, "--resume --memory 48MiB --checkpoint-every 3").ok();
    assert!(model(&part, 6) == model(&run, 6));
    assert!(files(&part)["config.toml"] == before["config.toml"]);
    let part = root.path().join("remedy");
    copy_unfinished(&run, &part, 6);
    for remedy in remedies(&train(scene.path(), &part, "--resume --tile-cap 10M")) {
        train(scene.path(), &part, &format!("--resume {remedy}")).ok();
    }
    assert!(model(&part, 6) == model(&run, 6));
}

/// What is set aside for rows and pairs that never come is not resident.
#[test]
#[cfg(target_os = "linux")]
fn memory_is_taken_as_it_is_needed() {
    let scene = Photographs::colmap_text();
    let (_root, run) = scratch();
    train(scene.path(), &run, "--budget 400k --init random --init-points 500 --iterations 2").ok();
    let summary = json(&run.join("stats/summary.json"));
    let (peak, promised) = (count(&summary, "peak_bytes"), count(&summary, "ledger_bytes"));
    assert!(promised > 400 * MIB && peak < promised / 4, "{peak} of {promised}");
}

/// What becomes of a run that may have so much address space `[KiB]`: its exit code, what it has said,
/// and whether it has left anything.
#[cfg(target_os = "linux")]
fn limited(limit: usize, flags: &str) -> (Option<i32>, String, bool) {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    let program = env!("CARGO_BIN_EXE_densify");
    let call = format!(
        "ulimit -v {limit} && exec {program} train {} -o {} --iterations 1 --quiet {flags}",
        text(scene.path()),
        text(&run)
    );
    let mut shell = std::process::Command::new("sh");
    shell.envs((!flags.contains("--gpu")).then_some(WITHOUT_GPU));
    let outcome = shell.args(["-c", &call]).output().expect("a shell");
    let said = String::from_utf8_lossy(&outcome.stderr).into_owned();
    (outcome.status.code(), said, !files(root.path()).is_empty())
}

/// From far too little to plenty, each limit of the address space ends in a message or in a model.
#[test]
#[cfg(target_os = "linux")]
fn a_system_that_grants_too_little_is_named_and_nothing_is_written() {
    let (mut refused, mut trained, mut remedies) = (0, 0, 0);
    for limit in (150_000..=1_350_000).step_by(100_000) {
        let flags = "--budget 150k --init random --threads 2 --backend cpu";
        match limited(limit, flags) {
            (Some(0), _, true) => trained += 1,
            (Some(3), said, false) => {
                assert!(said.starts_with("error: "), "{limit}: {said}");
                refused += usize::from(said.contains("ulimit -v"));
                for remedy in said.split("; give ").nth(1).iter().flat_map(|it| it.split(", or ")) {
                    if remedy.starts_with("--") {
                        let (code, said, _) = limited(limit, &followed(flags, remedy));
                        assert_eq!(code, Some(0), "{limit}: {remedy}: {said}");
                        remedies += 1;
                    }
                }
            }
            other => panic!("{limit} KiB end in {other:?}"),
        }
    }
    assert!(refused >= 3 && trained >= 2, "{refused} refused, {trained} trained");
    assert!(remedies >= 2, "{remedies} remedies");
}

/// llvmpipe's device memory is the process's own, so that it can be made to run out where the device's
/// buffers are created. (SwiftShader's code generator ends the process where it gets no memory.)
#[test]
#[ignore = "takes a minute: run by .ci/run"]
#[cfg(target_os = "linux")]
fn a_device_that_runs_out_of_memory_is_named_and_nothing_is_written() {
    let is_llvmpipe = |name: &&str| name.contains("llvmpipe");
    let mut names = crate::subject::devices().iter().map(|device| &device.adapter().name[..]);
    let Some(name) = names.find(is_llvmpipe) else { return };
    let flags = format!("--budget 1500k --tile-cap 100k --gpu '{name}'");
    let mut refused = 0;
    for limit in (1_400_000..=4_400_000).step_by(200_000) {
        match limited(limit, &flags) {
            // How much a driver takes for itself is its own affair, and more with more threads.
            (Some(0), _, true) => {}
            (Some(3), said, false) => {
                assert!(said.starts_with("error: "), "{limit} KiB: {said}");
                refused += usize::from(said.contains("for the training buffers; lower --budget"));
            }
            other => panic!("{limit} KiB end in {other:?}"),
        }
    }
    assert!(refused > 0, "the device refused nothing");
    let (code, said, _) = limited(16_000_000, &flags);
    assert_eq!(code, Some(0), "{said}");
}
