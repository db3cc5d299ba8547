//! `--poses`: poses decided about, refined, saved and resumed; no effect on a scene with good poses.

use std::path::Path;

use super::{config, copy_unfinished, json, model, read, resume, scratch, spheres, text, train};

const ITERATIONS: u32 = 90;

#[test]
fn good_poses_stay_and_wrong_ones_are_refined() {
    let (root, whole) = scratch();
    let [good, wrong] = ["good", "wrong"].map(|name| root.path().join(name));
    spheres(&good, "--train 14");
    spheres(&wrong, "--train 14 --pose-noise 2 --position-noise 0.02");
    let flags = "--eval --backend cpu --budget 1700 --checkpoint-every 60";
    let fixed = root.path().join("fixed");
    train(&good, &fixed, ITERATIONS, flags).ok();
    let auto = root.path().join("auto");
    let outcome = train(&good, &auto, ITERATIONS, &format!("{flags} --poses auto")).ok();
    assert!(outcome.stdout.contains("poses    fixed (auto): judged by"), "{}", outcome.stdout);
    assert!(model(&auto, ITERATIONS) == model(&fixed, ITERATIONS), "auto must change nothing");
    let left_out = json(&auto.join("stats/requirements.json"))["left_out"].to_string();
    assert!(left_out.contains("refinement of poses"), "{left_out}");

    let refine = format!("{flags} --poses auto");
    let outcome = train(&wrong, &whole, ITERATIONS, &format!("{refine} --threads 1")).ok();
    for words in
        ["poses    refined (auto)", "after an adjustment", "with the best pose", "moved by"]
    {
        assert!(outcome.stdout.contains(words), "{words}: {}", outcome.stdout);
    }
    assert!(config(&whole)["resolved"]["refines_poses"].as_bool().unwrap_or_default());
    let truth = train_cameras(&good);
    let [before, after] =
        [train_cameras(&wrong), run_cameras(&whole)].map(|cameras| off(&cameras, &truth));
    assert!(after < 0.2 * before, "{before} {after}");
    let scores = &json(&whole.join("results.json"))["ours_90"];
    assert!(scores["PSNR_fitted"].is_f64(), "{scores}");

    let threads = root.path().join("threads");
    train(&wrong, &threads, ITERATIONS, &format!("{refine} --threads 3")).ok();
    let part = root.path().join("part");
    copy_unfinished(&whole, &part, ITERATIONS);
    assert!(resume(&wrong, &part, "").ok().stdout.contains("from step 60"));
    for run in [&threads, &part] {
        assert!(model(run, ITERATIONS) == model(&whole, ITERATIONS), "{}", run.display());
        assert!(read(&run.join("cameras.json")) == read(&whole.join("cameras.json")));
    }
    resume(&wrong, &whole, "--poses fixed").refused("other poses", &["--poses", "contradicts"]);
}

#[test]
fn contradictory_options_are_refused() {
    let (root, run) = scratch();
    let scene = root.path().join("scene");
    spheres(&scene, "--train 14");
    train(&scene, &run, 10, "--refine-focal")
        .refused("fixed poses", &["--refine-focal", "--poses refine"]);
    let frozen = root.path().join("frozen");
    train(&scene, &frozen, 10, "--budget 1700 --backend cpu").ok();
    let flags = format!("--poses auto --freeze {} --budget 3000", text(&frozen));
    train(&scene, &run, 10, &flags).refused("frozen rows", &["--poses auto", "--freeze"]);
}

/// Names and centres of cameras.
type Centres = Vec<(String, [f64; 3])>;

/// The cameras of the training views as a run saves them.
fn run_cameras(run: &Path) -> Centres {
    let cameras = json(&run.join("cameras.json"));
    let all = cameras.as_array().expect("a list").iter().map(|camera| {
        let name = camera["img_name"].as_str().expect("a name").to_owned();
        (name, numbers(&camera["position"]))
    });
    all.filter(|(name, _)| name.contains("train")).collect()
}

/// The cameras of the training views of a scene.
fn train_cameras(scene: &Path) -> Centres {
    let frames = &json(&scene.join("transforms_train.json"))["frames"];
    let all = frames.as_array().expect("frames").iter().map(|frame| {
        let name = frame["file_path"].as_str().expect("a path").rsplit('/').next();
        let matrix = &frame["transform_matrix"];
        let centre = [0, 1, 2].map(|row: usize| matrix[row][3].as_f64().expect("a number"));
        (name.unwrap_or_default().to_owned(), centre)
    });
    all.collect()
}

fn numbers(value: &serde_json::Value) -> [f64; 3] {
    [0, 1, 2].map(|i: usize| value[i].as_f64().expect("a number"))
}

/// The largest distance between cameras of the same name.
fn off(found: &Centres, truth: &Centres) -> f64 {
    assert_eq!(found.len(), truth.len());
    let stem = |name: &str| name.trim_end_matches(".png").rsplit('/').next().map(str::to_owned);
    let apart = |(name, at): &(String, [f64; 3])| {
        let (_, to) =
            truth.iter().find(|(other, _)| stem(other) == stem(name)).expect("the same view");
        at.iter().zip(to).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt()
    };
    found.iter().map(apart).fold(0.0, f64::max)
}
