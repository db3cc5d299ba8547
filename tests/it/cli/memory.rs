//! `--memory` and `densify plan`: runs stay within the promised memory, plan and train agree, and limits too small
//! for any model are refused with the smallest that works.

use std::path::Path;

use densify_policies::registry::{find, policies};

use super::{
    Outcome, WITHOUT_GPU, call, config, copy_unfinished, count, densify, files, frequent_edits,
    json, model, records, scratch, text,
};
use crate::photographs::Photographs;

const MIB: u64 = 1 << 20;

fn plan(scene: &Path, flags: &str) -> Outcome {
    call(&format!("plan {} --backend cpu {flags}", text(scene)))
}

fn train(scene: &Path, run: &Path, flags: &str) -> Outcome {
    call(&format!("train {} -o {} --backend cpu {flags}", text(scene), text(run)))
}

/// The memory ledger in the output.
fn ledger(outcome: &Outcome) -> &str {
    let start = outcome.stdout.find("memory promised").expect("a ledger");
    let table = &outcome.stdout[start..];
    let total = table.find("\n  total").expect("its total");
    let end = table[total + 1..].find('\n').map_or(table.len(), |end| total + 1 + end);
    &table[..end]
}

/// The line with the budget of Gaussians.
fn budget(outcome: &Outcome) -> &str {
    let mut lines = outcome.stdout.lines();
    lines.find(|line| line.starts_with("budget ")).expect("a budget")
}

/// `plan` reports the least memory that holds the budget, and how much more serves only speed.
#[test]
fn the_reported_least_memory_holds_the_budget() {
    let scene = Photographs::colmap_text();
    let planned = plan(scene.path(), "--budget 300k").ok().stdout;
    let needed = planned.split("\nneeded   ").nth(1).expect("a line");
    let (needed, speed) = needed.split_once(" MiB; the other ").expect("two sizes");
    let mebibytes = |text: &str| text.replace(',', "").parse::<f64>().expect("a number");
    let (needed, speed) = (mebibytes(needed), mebibytes(speed.split(' ').next().unwrap()));
    assert!(speed > 100.0 && planned.contains("with --memory they"), "{planned}");
    let at = |memory: f64| plan(scene.path(), &format!("--budget 300k --memory {memory}MiB"));
    assert!(budget(&at(needed.ceil() + 1.0).ok()).starts_with("budget   300,000 rows"));
    assert!(!budget(&at(needed.ceil() - 1.0).ok()).starts_with("budget   300,000 rows"));
    assert!(!at(needed.ceil() + 1.0).stdout.contains("\nneeded"));
}

#[test]
fn plan_matches_train_and_writes_nothing() {
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
            ledger(&planned).lines().skip(1).filter(|line| !line.ends_with(')')).collect();
        let (total, lines) = lines.split_last().expect("a total");
        assert_eq!(lines.iter().map(|line| tenths(line)).sum::<u64>(), tenths(total), "{flags}");
        let has_remainder = planned.stdout.contains("of --memory\n");
        assert_eq!(has_remainder, flags.contains("--memory"), "{flags}: {}", planned.stdout);
        assert_eq!(budget(&planned), budget(&trained), "{flags}");
        let summary = json(&run.join("stats/summary.json"));
        let rows = format!("budget   {}", with_thousands_separators(count(&summary, "budget")));
        assert!(budget(&planned).starts_with(&rows), "{flags}: {}", budget(&planned));
        for words in ["Gaussians that --memory", "-r 1 (48x40)", "-r 4 (12x10)", "degree 3"] {
            assert!(planned.stdout.contains(words), "{flags}: {words:?} in {}", planned.stdout);
        }
    }
}

fn with_thousands_separators(number: u64) -> String {
    match (number / 1000, number % 1000) {
        (0, rest) => rest.to_string(),
        (thousands, rest) => format!("{},{rest:03}", with_thousands_separators(thousands)),
    }
}

#[test]
fn a_run_stays_within_its_memory_limit() {
    let scene = Photographs::transforms();
    for (memory, policy, preset, points) in [
        (48, "diet", "exact", "17k"),
        (64, "taming", "exact", "30k"),
        (64, "mcmc", "exact", "100k"),
        // A copy of this model as f32 would be half of the promised memory.
        (256, "diet", "tiny-memory", "245k"),
    ] {
        let (_root, run) = scratch();
        // A run that starts with a nearly full budget and edits often needs all of the promised memory.
        let often = frequent_edits(find(policy).expect("it is registered"));
        let flags = format!("--policy {policy} {often} --preset {preset} --init-points {points}");
        let flags = format!("{flags} --memory {memory}MiB --eval --iterations 12");
        train(scene.path(), &run, &format!("{flags} --test-iterations 3 --checkpoint-every 5"))
            .ok();
        let summary = json(&run.join("stats/summary.json"));
        let (budget, promised) = (count(&summary, "budget"), count(&summary, "ledger_bytes"));
        assert_eq!(count(&summary, "memory"), memory * MIB, "{flags}");
        assert!(promised <= memory * MIB, "{flags}: {promised} promised");
        // The limit is used to at least 90 %.
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

/// Memory per Gaussian, including the temporary buffers of policy events.
#[test]
fn tiny_memory_needs_at_most_480_bytes_per_gaussian() {
    let scene = Photographs::colmap_text();
    for policy in ["vanilla", "diet", "mcmc"] {
        let [fewer, more] = ["256MiB", "512MiB"].map(|memory| {
            let flags = format!("--policy {policy} --preset tiny-memory --sh-degree 3");
            let planned = plan(scene.path(), &format!("{flags} --memory {memory}")).ok();
            let rows = budget(&planned).trim_start_matches("budget").trim_start();
            let rows: String =
                rows.chars().take_while(|c| *c != ' ').filter(|c| *c != ',').collect();
            rows.parse::<u64>().expect("a number of rows")
        });
        let bytes = 256.0 * MIB as f64 / (more - fewer) as f64;
        assert!(
            bytes > 300.0 && bytes <= 480.0,
            "{policy}: {bytes} bytes, {fewer} and {more} Gaussians"
        );
    }
}

#[test]
fn on_a_gpu_the_limit_applies_to_device_memory() {
    let scene = Photographs::colmap_text();
    let mut rows: Vec<(&str, u64)> = Vec::new();
    for device in crate::subject::devices_by_accumulation() {
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
        // `gpu::ledger` checks that the backend allocates exactly what the ledger says.
        // Small buffers grow in steps: their sizes are powers of two.
        assert!(bytes <= 48 * MIB && bytes > 42 * MIB, "{name}: {bytes}");
        assert!(planned.stdout.contains("on the device"), "{name}: {}", planned.stdout);
        // Accumulation by atomics needs no gradient records, which leaves room for more Gaussians.
        let most = count(&summary, "budget");
        let in_slots = rows.iter().find(|(other, _)| other == name).map(|(_, rows)| *rows);
        let is_in_slots = device.accumulation().is_deterministic();
        assert!(is_in_slots || in_slots.is_some_and(|rows| most > rows + rows / 10), "{name}");
        rows.push((name, most));
    }
}

#[test]
fn the_smaller_of_budget_and_memory_applies() {
    let scene = Photographs::colmap_text();
    let plan = |flags: &str| plan(scene.path(), flags).ok();
    let by_budget = plan("--budget 500 --memory 1GiB");
    assert!(budget(&by_budget).ends_with("500 rows: --memory 1.0 GiB would hold as many or more"));
    let by_memory = plan("--budget 3M --memory 64MiB");
    assert!(budget(&by_memory).ends_with("holds fewer than --budget 3,000,000"));
    assert_eq!(budget(&plan("--memory 64MiB")), budget(&plan("--memory 64MiB --threads 5")));
    // The SH degree is lowered only if the initial points would not fit otherwise.
    assert!(plan("--memory 40MiB").stdout.contains("degree 3,"));
    let lowered = plan("--memory 64MiB --init-points 45k").stdout;
    assert!(!lowered.contains("degree 3,") && lowered.contains("instead of 3"), "{lowered}");
    let kept = plan("--memory 64MiB --init-points 45k --sh-degree 3").stdout;
    assert!(kept.contains("degree 3,") && !kept.contains("instead"), "{kept}");
}

/// The remedies that a refusal lists, in order.
fn remedies(outcome: &Outcome) -> Vec<String> {
    let listed = outcome.stderr.split("; give ").nth(1).expect("a remedy").trim();
    listed.split(", or ").map(str::to_owned).collect()
}

/// Applies a remedy to flags: `--flag value` is added or replaces another value, `no --flag` removes the flag.
fn apply_remedy(flags: &str, remedy: &str) -> String {
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
fn too_little_memory_is_refused_with_remedies_in_order_of_cost() {
    let scene = Photographs::colmap_text();
    let plan = |flags: &str| plan(scene.path(), flags);
    // Dropping the image cache comes first, because it costs only decoding time.
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
        let [more_memory] = &remedies(&outcome)[..] else { panic!("expected one remedy") };
        plan(&apply_remedy(flags, more_memory)).ok();
        let mib = more_memory.trim_start_matches("--memory ").trim_end_matches("MiB");
        let mib: u64 = mib.parse().unwrap_or_else(|e| panic!("{more_memory}: {e}"));
        // Bisects for the largest limit [KiB] that is too small: there, every remedy saves enough.
        let (mut too_small, mut enough) = ((mib - 1) << 10, mib << 10);
        while enough - too_small > 1 {
            let middle = (too_small + enough) / 2;
            let fits = plan(&format!("--memory {middle}KiB {flags}")).code == Some(0);
            *(if fits { &mut enough } else { &mut too_small }) = middle;
        }
        let flags = format!("--memory {too_small}KiB {flags}");
        let outcome = plan(&flags);
        outcome.refused(&flags, &[more_memory]);
        let all = remedies(&outcome);
        assert_eq!(all[..2], ["--image-cache 0", second], "{flags}: {all:?}");
        for remedy in all {
            plan(&apply_remedy(&flags, &remedy)).ok();
        }
    }
    let refused = |flags: &str, words| plan(flags).refused(flags, words);
    refused("--memory 0", &["--memory 0 B"]);
    refused("--memory plenty", &["--memory", "plenty", "512MiB"]);
    refused("--resume", &["--resume"]);
}

/// Without `--memory`, the table uses the planned memory in whole mebibytes.
#[test]
fn the_table_of_capacities_is_exact() {
    let photographs = Photographs::colmap_text();
    let (photographs, known) = (photographs.path(), Path::new("scene:spheres"));
    // Rendering a scene for the first time makes the process grow, so it is cached first.
    plan(known, "").ok();
    for (scene, flags) in [
        (photographs, "--budget 20k"),
        (photographs, "--budget 20k --preset tiny-memory --policy taming"),
        (photographs, ""),
        // Measuring the geometry takes more than training.
        (known, "--budget 20k --preset tiny-memory --eval"),
    ] {
        let planned = plan(scene, flags).ok();
        let heading = planned.stdout.split("Gaussians that --memory ").nth(1).expect("a table");
        let (memory, table) = heading.split_once("MiB").expect("a size");
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
fn a_run_with_a_memory_limit_resumes_with_its_chosen_sizes() {
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
        // This would not change the result, but exceeds the memory limit.
        ("--tile-cap 10M", ["--memory 48.0 MiB", "give --tile-cap"]),
    ] {
        train(scene.path(), &run, &format!("--resume {flags}")).refused(flags, &words);
        assert!(files(&run) == before, "{flags} changed the run");
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

/// Memory reserved for Gaussians and pairs that are never created must not become resident.
#[test]
#[cfg(target_os = "linux")]
fn unused_reservations_are_not_resident() {
    let scene = Photographs::colmap_text();
    let (_root, run) = scratch();
    train(scene.path(), &run, "--budget 400k --init random --init-points 500 --iterations 2").ok();
    let summary = json(&run.join("stats/summary.json"));
    let (peak, promised) = (count(&summary, "peak_bytes"), count(&summary, "ledger_bytes"));
    assert!(promised > 400 * MIB && peak < promised / 4, "{peak} of {promised}");
}

/// Trains with limited address space `[KiB]`. Returns the exit code, the messages and whether files were written.
#[cfg(target_os = "linux")]
fn train_with_limit(limit: usize, flags: &str) -> (Option<i32>, String, bool) {
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
    let stderr = String::from_utf8_lossy(&outcome.stderr).into_owned();
    (outcome.status.code(), stderr, !files(root.path()).is_empty())
}

/// At every limit of the address space, from far too little to plenty, the run ends with an error message or a model.
#[test]
#[cfg(target_os = "linux")]
fn a_failed_allocation_is_reported_with_remedies_and_writes_nothing() {
    let (mut refused, mut trained, mut remedies) = (0, 0, 0);
    for limit in (150_000..=1_350_000).step_by(100_000) {
        let flags = "--budget 150k --init random --threads 2 --backend cpu";
        match train_with_limit(limit, flags) {
            (Some(0), _, true) => trained += 1,
            (Some(3), stderr, false) => {
                assert!(stderr.starts_with("error: "), "{limit}: {stderr}");
                refused += usize::from(stderr.contains("ulimit -v"));
                for remedy in
                    stderr.split("; give ").nth(1).iter().flat_map(|list| list.split(", or "))
                {
                    if remedy.starts_with("--") {
                        let (code, stderr, _) =
                            train_with_limit(limit, &apply_remedy(flags, remedy));
                        assert_eq!(code, Some(0), "{limit}: {remedy}: {stderr}");
                        remedies += 1;
                    }
                }
            }
            other => panic!("{limit} KiB: {other:?}"),
        }
    }
    assert!(refused >= 3 && trained >= 2, "{refused} refused, {trained} trained");
    assert!(remedies >= 2, "{remedies} remedies");
}

/// llvmpipe takes device memory from the process, so an address space limit makes creating device buffers fail.
/// (SwiftShader's code generator aborts the process when it gets no memory.)
#[test]
#[ignore = "takes a minute: run by .ci/run"]
#[cfg(target_os = "linux")]
fn a_device_out_of_memory_is_reported_and_writes_nothing() {
    let is_llvmpipe = |name: &&str| name.contains("llvmpipe");
    let mut names = crate::subject::devices().iter().map(|device| &device.adapter().name[..]);
    let Some(name) = names.find(is_llvmpipe) else { return };
    let flags = format!("--budget 1500k --tile-cap 100k --gpu '{name}'");
    let mut refused = 0;
    for limit in (1_400_000..=4_400_000).step_by(200_000) {
        match train_with_limit(limit, &flags) {
            // The limit at which training succeeds depends on the driver and its number of threads.
            (Some(0), _, true) => {}
            (Some(3), stderr, false) => {
                assert!(stderr.starts_with("error: "), "{limit} KiB: {stderr}");
                refused += usize::from(stderr.contains("for the training buffers; lower --budget"));
            }
            other => panic!("{limit} KiB: {other:?}"),
        }
    }
    assert!(refused > 0, "the device never ran out of memory");
    let (code, stderr, _) = train_with_limit(16_000_000, &flags);
    assert_eq!(code, Some(0), "{stderr}");
}
