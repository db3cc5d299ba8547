//! `densify blocks`: a scene is divided, trained block by block and merged, locally or by a scheduler.

use std::path::Path;

use toml::Table;

use super::{Outcome, call, count, gaussians, json, read, read_text, scratch, text};
#[cfg(unix)]
use super::{call_with_path, run_array_task, write_program};
use crate::photographs::{Photographs, VIEWS};

/// Plans two blocks of a small scene.
fn plan(scene: &Path, folder: &Path, more: &str) -> Outcome {
    let sizes = "--rows 400 --blocks 2x1 --coarse-rows 150";
    let train = "-i 120 --sh-degree 1 --backend cpu --checkpoint-every 40";
    call(&format!(
        "blocks plan {} -o {} {sizes} {more} -- {train} --policy-set diet.grow_every=20",
        text(scene),
        text(folder)
    ))
}

fn blocks(words: &str, folder: &Path) -> Outcome {
    let (command, rest) = words.split_once(' ').unwrap_or((words, ""));
    call(&format!("blocks {command} {} {rest}", text(folder)))
}

/// The lines of `blocks status` with single spaces.
fn status(folder: &Path) -> Vec<String> {
    let stdout = blocks("status", folder).ok().stdout;
    stdout.lines().map(|line| line.split_whitespace().collect::<Vec<_>>().join(" ")).collect()
}

#[test]
fn blocks_are_trained_and_merged_into_one_model() {
    let scene = Photographs::colmap_text();
    let (_root, folder) = scratch();
    let stdout = plan(scene.path(), &folder, "").ok().stdout;
    assert!(stdout.contains("block-0-0") && stdout.contains("block-1-0"), "{stdout}");
    assert!(read(&folder.join("plan.svg")).starts_with(b"<svg"));
    let plan: Table = read_text(&folder.join("plan.toml")).parse().expect("a TOML file");
    let listed = plan["block"].as_array().expect("a list of blocks");
    let number = |block: &toml::Value, key: &str| block[key].as_integer().expect("a number") as u64;
    assert!(listed.iter().map(|block| number(block, "rows")).sum::<u64>() <= 400);
    for name in ["block-0-0", "block-1-0"] {
        let views = read_text(&folder.join("blocks").join(name).join("views.txt"));
        assert!((1..=VIEWS).contains(&views.lines().count()), "{views}");
        assert!(views.lines().all(|view| view.starts_with("view_")), "{views}");
        // Most views are cropped to the part that shows the block.
        assert!(2 * views.matches('\t').count() > views.lines().count(), "{views}");
    }
    let waiting = ["coarse waiting", "block-0-0 waiting", "block-1-0 waiting", "merge waiting"];
    assert_eq!(status(&folder)[..4], waiting);
    blocks("run block-1-0", &folder).refused("no coarse model", &["block-1-0", "coarse"]);
    let merged = folder.join("whole.ply");
    let merge =
        |flags: &str| blocks(&format!("merge -o {} --overwrite {flags}", text(&merged)), &folder);
    merge("").refused("nothing is trained", &["block-0-0, block-1-0", "--partial"]);
    assert!(!merged.exists());

    let stdout = blocks("submit", &folder).ok().stdout;
    assert!(stdout.contains("started  coarse") && stdout.contains("ended    merge"), "{stdout}");
    assert_eq!(status(&folder).last().unwrap(), "4 complete, 0 to go");
    merge("").ok();
    let whole = read(&merged);
    assert!(whole == read(&folder.join("merged.ply")));
    let rows = gaussians(&merged).len();
    assert!((200..=400).contains(&rows), "{rows} rows");
    for block in listed {
        let name = block["name"].as_str().expect("a name");
        let summary = json(&folder.join("blocks").join(name).join("run/stats/summary.json"));
        // The peak includes the frozen Gaussians of the coarse model.
        assert!(count(&summary, "peak_rows") <= number(block, "budget") + 150, "{summary}");
        assert!(number(block, "budget") > number(block, "rows"), "{block}: there is no margin");
        assert!(count(&summary, "peak_bytes") <= number(block, "memory"), "{block}: {summary}");
    }
    let stdout = blocks("submit", &folder).ok().stdout;
    assert!(stdout.contains("every task is complete"), "{stdout}");

    // A block whose training is killed and resumed gives the same model, byte for byte.
    let run = folder.join("blocks/block-1-0/run");
    let iterations = number(&listed[1], "iterations");
    std::fs::remove_dir_all(run.join(format!("point_cloud/iteration_{iterations}"))).unwrap();
    std::fs::remove_file(run.join("stats/summary.json")).unwrap();
    std::fs::remove_file(run.join(format!("checkpoints/iteration_{iterations}.safetensors")))
        .unwrap();
    assert!(
        status(&folder)[2].starts_with("block-1-0 stopped, saved 80 of"),
        "{:?}",
        status(&folder)
    );
    let part = merge("--partial").ok().stdout;
    assert!(part.contains("incomplete blocks left out: block-1-0"), "{part}");
    let part = gaussians(&merged).len();
    assert!((1..rows).contains(&part), "{part} of {rows}");
    blocks("submit", &folder).ok();
    merge("").ok();
    assert!(read(&merged) == whole);

    // Merging writes other formats too, and never replaces a file unasked.
    let spz = folder.join("whole.spz");
    blocks(&format!("merge -o {}", text(&spz)), &folder).ok();
    assert_eq!(gaussians(&spz).len(), rows);
    blocks(&format!("merge -o {}", text(&spz)), &folder).refused("it exists", &["--overwrite"]);
}

/// Scheduler jobs produce the same model as a local run. A stand-in for `sbatch` records its arguments; the test then
/// runs the scripts itself.
#[cfg(unix)]
#[test]
fn scheduler_scripts_produce_the_same_model() {
    let scene = Photographs::colmap_text();
    let (root, folder) = scratch();
    plan(scene.path(), &folder, "").ok();
    let local = root.path().join("local");
    plan(scene.path(), &local, "").ok();
    blocks("submit", &local).ok();

    let bin = root.path().join("bin");
    std::fs::create_dir(&bin).unwrap();
    let submit = |flags: &str, path: &str| {
        call_with_path(&format!("blocks submit {} {flags}", text(&folder)), path)
    };
    submit("--engine slurm", text(&bin)).refused("no Slurm", &["sbatch", "PATH"]);
    submit("--engine hq", text(&bin)).refused("no HyperQueue", &["hq", "PATH"]);
    assert!(!folder.join("submitted.toml").exists());

    let shown = submit("--engine slurm --dry-run", text(&bin)).ok().stdout;
    let calls = root.path().join("calls");
    let counted = "wc -l <";
    let script = format!("echo \"$@\" >> {0}; echo \"$({counted} {0});cluster\"", text(&calls));
    write_program(&bin, "sbatch", &script);
    let path = format!("{}:{}", text(&bin), std::env::var("PATH").unwrap());
    let stdout = submit("--engine slurm", &path).ok().stdout;
    assert!(stdout.contains("1, 2, 3"), "{stdout}");
    let calls = read_text(&calls);
    let calls: Vec<&str> = calls.lines().collect();
    assert!(!calls[0].contains("--dependency"), "{calls:?}");
    assert!(calls[1].contains("--dependency=afterok:1 ") && calls[2].contains("afterok:2 "));
    submit("--engine slurm", &path).refused("twice", &["1, 2, 3", "--again"]);
    let script = |name: &str| folder.join("slurm").join(format!("{name}.sh"));
    let array = read_text(&script("blocks"));
    assert!(shown.contains(&array), "{shown}");
    let plan: Table = read_text(&folder.join("plan.toml")).parse().expect("a TOML file");
    let memory = |block: &toml::Value| block["memory"].as_integer().expect("a number");
    let most = plan["block"].as_array().unwrap().iter().map(memory).max().unwrap();
    let requested = array.lines().find_map(|line| line.strip_prefix("#SBATCH --mem=")).unwrap();
    let requested: i64 = requested.trim_end_matches('M').parse().expect("a number");
    assert_eq!(requested, (most + (1 << 20) - 1) >> 20);
    assert!(array.contains("#SBATCH --array=0,1\n") && array.contains("#SBATCH --requeue\n"));
    for (name, index) in [("coarse", ""), ("blocks", "1"), ("blocks", "0"), ("merge", "")] {
        run_array_task(&script(name), index);
    }
    assert!(read(&folder.join("merged.ply")) == read(&local.join("merged.ply")));

    // The same plan as a HyperQueue job, with one block and the merge left to do.
    std::fs::remove_file(folder.join("merged.ply")).unwrap();
    std::fs::remove_dir_all(folder.join("blocks/block-0-0/run")).unwrap();
    write_program(&bin, "hq", "[ \"$3\" = submit-file ] && [ -f \"$4\" ] && echo 7");
    submit("--engine hq", &path).refused("twice", &["--again"]);
    submit("--engine hq --again --mem-resource", &path).ok();
    let job: Table = read_text(&folder.join("hq/job.toml")).parse().expect("a TOML file");
    let tasks = job["task"].as_array().expect("tasks");
    let last_word =
        |task: &toml::Value| task["command"].as_array().unwrap().last().unwrap().clone();
    assert_eq!(tasks.len(), 2);
    assert_eq!([last_word(&tasks[0]), last_word(&tasks[1])], ["block-0-0".into(), "merge".into()]);
    assert!(tasks[0].get("deps").is_none());
    assert_eq!(tasks[1]["deps"], toml::Value::from(vec![0]));
    let resources = &tasks[0]["request"].as_array().unwrap()[0]["resources"];
    assert_eq!(resources["mem"].as_integer(), Some(memory(&plan["block"].as_array().unwrap()[0])));
}

#[test]
fn impossible_plans_are_refused_and_write_nothing() {
    let scene = Photographs::colmap_text();
    let (root, folder) = scratch();
    let plan = |words: &str| {
        let outcome =
            call(&format!("blocks plan {} -o {} {words}", text(scene.path()), text(&folder)));
        assert!(!folder.exists(), "{words}");
        outcome
    };
    plan("--rows 400 --blocks 9x9 -- -i 20").refused("too many", &["of 9x9", "--blocks", "--rows"]);
    plan("--rows 50 --blocks 2").refused("too few rows", &["50 Gaussians", "--rows"]);
    plan("--rows 400 --blocks 2 -- --view").refused("the plan's", &["--view"]);
    plan("--rows 400 --blocks 2 -- --budget 9").refused("the plan's", &["--budget", "plan itself"]);
    plan("--rows 400 --blocks 2 -- --sh-degree auto").refused("auto", &["--sh-degree auto"]);
    plan("--rows 400 --blocks 2 -- --coordinates double").refused("f64", &["--coordinates double"]);
    plan("--rows 400 --blocks 2 -- --poses refine").refused("poses", &["--poses refine", "agree"]);
    plan("--rows 400 --blocks 2 -- --exposure auto")
        .refused("auto", &["--exposure auto", "give on or off"]);
    plan("--rows 400").refused("auto needs memory", &["--memory"]);
    plan("--blocks 2").refused("no size", &["--rows"]);
    plan("--rows 400 --blocks 0").refused("no block", &["--blocks", "3x2"]);
    plan("--rows 1M --memory 64MiB -- -i 20 --backend cpu --threads 2")
        .refused("too large for any", &["--memory", "fits"]);
    let left: Vec<_> = std::fs::read_dir(root.path()).unwrap().collect();
    assert!(left.is_empty(), "{left:?}");

    // `plan` chooses enough blocks for each to fit into the memory together with the Gaussians of the coarse model.
    let most = 96 << 20;
    let bounded = read_plan(
        scene.path(),
        &folder,
        "--rows 100k --memory 96MiB -- -i 20 --backend cpu --threads 2",
    );
    let listed = bounded["block"].as_array().expect("a list of blocks");
    assert!(listed.len() >= 2, "{bounded}");
    for block in listed {
        assert!(block["memory"].as_integer().expect("a number") <= most, "{block}");
    }
    let coarse = |plan: &Table| plan["coarse"]["rows"].as_integer().expect("a number");
    assert!((1_000..40_000).contains(&coarse(&bounded)), "{bounded}");
    let unbounded =
        read_plan(scene.path(), &root.path().join("other"), "--rows 4000 --blocks 2 -- -i 20");
    assert_eq!(coarse(&unbounded), 1_600, "{unbounded}");
    // Learned exposures count towards the memory of each task.
    let words = "--rows 4000 --blocks 2 -- -i 20 --exposure on";
    let exposed = read_plan(scene.path(), &root.path().join("exposed"), words);
    let memory = |plan: &Table, at: usize| plan["block"][at]["memory"].as_integer();
    assert!((0..2).all(|at| memory(&exposed, at) > memory(&unbounded, at)), "{exposed}");
    let occupied = call(&format!(
        "blocks plan {} -o {} --rows 400 --blocks 2",
        text(scene.path()),
        text(&folder)
    ));
    occupied.refused("the folder is taken", &["not empty", "-o"]);
    blocks("run block-7-7", &folder).refused("no such task", &["block-7-7", "coarse"]);
    std::fs::remove_file(folder.join("coarse.toml")).unwrap();
    blocks("run coarse", &folder).refused("half deleted", &["coarse.toml", "plan again"]);
    std::fs::remove_file(folder.join("plan.toml")).unwrap();
    blocks("status", &folder).refused("no plan", &["plan.toml", "blocks plan"]);
}

/// Plans and returns the contents of `plan.toml`.
fn read_plan(scene: &Path, folder: &Path, words: &str) -> Table {
    call(&format!("blocks plan {} -o {} {words}", text(scene), text(folder))).ok();
    read_text(&folder.join("plan.toml")).parse().expect("a TOML file")
}

#[test]
fn a_run_uses_only_the_listed_views() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    let file = root.path().join("views.txt");
    let train = |names: &str| {
        std::fs::write(&file, names).unwrap();
        let flags = format!("--budget 200 --eval --views {} -i 4 --overwrite", text(&file));
        call(&format!("train {} -o {} {flags}", text(scene.path()), text(&run)))
    };
    // The first and ninth of the 14 views are held out, whichever views are listed.
    train("view_01.png\n\nview_08.png\n  view_03.png\n").ok();
    let summary = json(&run.join("stats/summary.json"));
    assert_eq!((count(&summary, "train_views"), count(&summary, "test_views")), (2, 1));
    train("view_01.png\nno.png\n").refused("an unknown view", &["line 2", "no.png", "views.txt"]);
    train("view_08.png\n").refused("nothing to train on", &["--views", "trained on"]);
    // A crop of a view of 48x40 px.
    let stdout = train("view_01.png\t0.2 0 0.9 1\n").ok().stdout;
    assert!(stdout.contains("up to 35x40 px"), "{stdout}");
    for wrong in ["0 0 1", "0.5 0 0.5 1", "0 0 1 1.1", "0 0 a 1"] {
        let words = ["views.txt", "line 1", "left, top, right and bottom"];
        train(&format!("view_01.png\t{wrong} \nview_03.png\n")).refused(wrong, &words);
    }
    std::fs::remove_file(&file).unwrap();
    let flags = format!("--budget 200 --views {} -i 4 --overwrite", text(&file));
    call(&format!("train {} -o {} {flags}", text(scene.path()), text(&run)))
        .refused("no file", &["--views", "views.txt"]);
}
