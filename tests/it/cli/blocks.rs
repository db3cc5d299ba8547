//! `densify blocks`: a scene divided, trained in parts and put together, whatever starts the parts.

use std::path::Path;

use toml::Table;

use super::{Outcome, call, count, gaussians, json, read, read_text, scratch, text};
#[cfg(unix)]
use super::{call_with_path, run_place, stand_in};
use crate::photographs::{Photographs, VIEWS};

/// Two blocks of a small scene.
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

/// The lines of `blocks status`, but for the spaces.
fn status(folder: &Path) -> Vec<String> {
    let said = blocks("status", folder).ok().stdout;
    said.lines().map(|line| line.split_whitespace().collect::<Vec<_>>().join(" ")).collect()
}

#[test]
fn a_scene_in_blocks_becomes_one_model() {
    let scene = Photographs::colmap_text();
    let (_root, folder) = scratch();
    let said = plan(scene.path(), &folder, "").ok().stdout;
    assert!(said.contains("block-0-0") && said.contains("block-1-0"), "{said}");
    assert!(read(&folder.join("plan.svg")).starts_with(b"<svg"));
    let plan: Table = read_text(&folder.join("plan.toml")).parse().expect("it is TOML");
    let listed = plan["block"].as_array().expect("a list of blocks");
    let number = |block: &toml::Value, key: &str| block[key].as_integer().expect("a number") as u64;
    assert!(listed.iter().map(|block| number(block, "rows")).sum::<u64>() <= 400);
    for name in ["block-0-0", "block-1-0"] {
        let views = read_text(&folder.join("blocks").join(name).join("views.txt"));
        assert!((1..=VIEWS).contains(&views.lines().count()), "{views}");
        assert!(views.lines().all(|view| view.starts_with("view_")), "{views}");
        // Of most only the part that shows the block.
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

    let said = blocks("submit", &folder).ok().stdout;
    assert!(said.contains("started  coarse") && said.contains("ended    merge"), "{said}");
    assert_eq!(status(&folder).last().unwrap(), "4 complete, 0 to go");
    merge("").ok();
    let whole = read(&merged);
    assert!(whole == read(&folder.join("merged.ply")));
    let rows = gaussians(&merged).len();
    assert!((200..=400).contains(&rows), "{rows} rows");
    for block in listed {
        let name = block["name"].as_str().expect("a name");
        let summary = json(&folder.join("blocks").join(name).join("run/stats/summary.json"));
        // Its own rows, and those of the coarse model that it has frozen.
        assert!(count(&summary, "peak_rows") <= number(block, "budget") + 150, "{summary}");
        assert!(number(block, "budget") > number(block, "rows"), "{block}: there is a margin");
        assert!(count(&summary, "peak_bytes") <= number(block, "memory"), "{block}: {summary}");
    }
    let said = blocks("submit", &folder).ok().stdout;
    assert!(said.contains("every task is complete"), "{said}");

    // A block that was killed before its end goes on to the same bytes.
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
    assert!(part.contains("not complete: block-1-0"), "{part}");
    let part = gaussians(&merged).len();
    assert!((1..rows).contains(&part), "{part} of {rows}");
    blocks("submit", &folder).ok();
    merge("").ok();
    assert!(read(&merged) == whole);

    // In another format, and never where something is already.
    let spz = folder.join("whole.spz");
    blocks(&format!("merge -o {}", text(&spz)), &folder).ok();
    assert_eq!(gaussians(&spz).len(), rows);
    blocks(&format!("merge -o {}", text(&spz)), &folder).refused("it exists", &["--overwrite"]);
}

/// The files for schedulers do what this machine does. Slurm's program is one that takes down how it is called; its
/// scripts are then run by hand.
#[cfg(unix)]
#[test]
fn schedulers_are_handed_what_makes_the_same_model() {
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
    stand_in(&bin, "sbatch", &script);
    let path = format!("{}:{}", text(&bin), std::env::var("PATH").unwrap());
    let said = submit("--engine slurm", &path).ok().stdout;
    assert!(said.contains("1, 2, 3"), "{said}");
    let calls = read_text(&calls);
    let calls: Vec<&str> = calls.lines().collect();
    assert!(!calls[0].contains("--dependency"), "{calls:?}");
    assert!(calls[1].contains("--dependency=afterok:1 ") && calls[2].contains("afterok:2 "));
    submit("--engine slurm", &path).refused("twice", &["1, 2, 3", "--again"]);
    let script = |name: &str| folder.join("slurm").join(format!("{name}.sh"));
    let array = read_text(&script("blocks"));
    assert!(shown.contains(&array), "{shown}");
    let plan: Table = read_text(&folder.join("plan.toml")).parse().expect("it is TOML");
    let memory = |block: &toml::Value| block["memory"].as_integer().expect("a number");
    let most = plan["block"].as_array().unwrap().iter().map(memory).max().unwrap();
    let asked = array.lines().find_map(|line| line.strip_prefix("#SBATCH --mem=")).unwrap();
    let asked: i64 = asked.trim_end_matches('M').parse().expect("a number");
    assert_eq!(asked, (most + (1 << 20) - 1) >> 20);
    assert!(array.contains("#SBATCH --array=0,1\n") && array.contains("#SBATCH --requeue\n"));
    for (name, place) in [("coarse", ""), ("blocks", "1"), ("blocks", "0"), ("merge", "")] {
        run_place(&script(name), place);
    }
    assert!(read(&folder.join("merged.ply")) == read(&local.join("merged.ply")));

    // The same as a job of HyperQueue, before anything was done.
    std::fs::remove_file(folder.join("merged.ply")).unwrap();
    std::fs::remove_dir_all(folder.join("blocks/block-0-0/run")).unwrap();
    stand_in(&bin, "hq", "[ \"$3\" = submit-file ] && [ -f \"$4\" ] && echo 7");
    submit("--engine hq", &path).refused("twice", &["--again"]);
    submit("--engine hq --again --mem-resource", &path).ok();
    let job: Table = read_text(&folder.join("hq/job.toml")).parse().expect("it is TOML");
    let tasks = job["task"].as_array().expect("tasks");
    let of = |task: &toml::Value| task["command"].as_array().unwrap().last().unwrap().clone();
    assert_eq!(tasks.len(), 2);
    assert_eq!([of(&tasks[0]), of(&tasks[1])], ["block-0-0".into(), "merge".into()]);
    assert!(tasks[0].get("deps").is_none());
    assert_eq!(tasks[1]["deps"], toml::Value::from(vec![0]));
    let resources = &tasks[0]["request"].as_array().unwrap()[0]["resources"];
    assert_eq!(resources["mem"].as_integer(), Some(memory(&plan["block"].as_array().unwrap()[0])));
}

#[test]
fn what_cannot_be_planned_is_named_and_nothing_is_written() {
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
    plan("--rows 400 --blocks 2 -- --view").refused("own", &["--view"]);
    plan("--rows 400 --blocks 2 -- --budget 9").refused("own", &["--budget", "plan itself"]);
    plan("--rows 400 --blocks 2 -- --sh-degree auto").refused("auto", &["--sh-degree auto"]);
    plan("--rows 400 --blocks 2 -- --exposure auto")
        .refused("auto", &["--exposure auto", "give on or off"]);
    plan("--rows 400").refused("auto needs memory", &["--memory"]);
    plan("--blocks 2").refused("no size", &["--rows"]);
    plan("--rows 400 --blocks 0").refused("no block", &["--blocks", "3x2"]);
    plan("--rows 1M --memory 64MiB -- -i 20 --backend cpu --threads 2")
        .refused("too large for any", &["--memory", "fits"]);
    let left: Vec<_> = std::fs::read_dir(root.path()).unwrap().collect();
    assert!(left.is_empty(), "{left:?}");

    // Few enough blocks for a memory are found; the coarse run leaves them room.
    let most = 96 << 20;
    let bounded = plan_of(
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
        plan_of(scene.path(), &root.path().join("other"), "--rows 4000 --blocks 2 -- -i 20");
    assert_eq!(coarse(&unbounded), 1_600, "{unbounded}");
    // What may be learned beside the model is a part of what each task takes.
    let words = "--rows 4000 --blocks 2 -- -i 20 --exposure on";
    let exposed = plan_of(scene.path(), &root.path().join("exposed"), words);
    let memory = |plan: &Table, at: usize| plan["block"][at]["memory"].as_integer();
    assert!((0..2).all(|at| memory(&exposed, at) > memory(&unbounded, at)), "{exposed}");
    let again = call(&format!(
        "blocks plan {} -o {} --rows 400 --blocks 2",
        text(scene.path()),
        text(&folder)
    ));
    again.refused("the folder is taken", &["not empty", "-o"]);
    blocks("run block-7-7", &folder).refused("no such task", &["block-7-7", "coarse"]);
    std::fs::remove_file(folder.join("coarse.toml")).unwrap();
    blocks("run coarse", &folder).refused("half deleted", &["coarse.toml", "plan again"]);
    std::fs::remove_file(folder.join("plan.toml")).unwrap();
    blocks("status", &folder).refused("no plan", &["plan.toml", "blocks plan"]);
}

/// Plans; returns what the plan says.
fn plan_of(scene: &Path, folder: &Path, words: &str) -> Table {
    call(&format!("blocks plan {} -o {} {words}", text(scene), text(folder))).ok();
    read_text(&folder.join("plan.toml")).parse().expect("it is TOML")
}

#[test]
fn a_run_uses_only_the_views_that_are_named() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    let file = root.path().join("views.txt");
    let train = |names: &str| {
        std::fs::write(&file, names).unwrap();
        let flags = format!("--budget 200 --eval --views {} -i 4 --overwrite", text(&file));
        call(&format!("train {} -o {} {flags}", text(scene.path()), text(&run)))
    };
    // Of 14 views the first and the ninth are held out, whichever are named.
    train("view_01.png\n\nview_08.png\n  view_03.png\n").ok();
    let summary = json(&run.join("stats/summary.json"));
    assert_eq!((count(&summary, "train_views"), count(&summary, "test_views")), (2, 1));
    train("view_01.png\nno.png\n").refused("an unknown view", &["line 2", "no.png", "views.txt"]);
    train("view_08.png\n").refused("nothing to train on", &["--views", "trained on"]);
    // A part of a view, of 48 by 40 pixels.
    let said = train("view_01.png\t0.2 0 0.9 1\n").ok().stdout;
    assert!(said.contains("up to 35x40 px"), "{said}");
    for wrong in ["0 0 1", "0.5 0 0.5 1", "0 0 1 1.1", "0 0 a 1"] {
        let words = ["views.txt", "line 1", "left, top, right and bottom"];
        train(&format!("view_01.png\t{wrong} \nview_03.png\n")).refused(wrong, &words);
    }
    std::fs::remove_file(&file).unwrap();
    let flags = format!("--budget 200 --views {} -i 4 --overwrite", text(&file));
    call(&format!("train {} -o {} {flags}", text(scene.path()), text(&run)))
        .refused("no file", &["--views", "views.txt"]);
}
