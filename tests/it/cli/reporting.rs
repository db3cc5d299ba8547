//! `densify report`: contents of the HTML file, which loads nothing else, and refused calls.

use std::path::{Path, PathBuf};

use image::RgbImage;
use serde_json::json;

use super::{Outcome, call, densify, files, json, read, read_text, scratch, text, train};
use crate::photographs::{Photographs, SIZE, VIEWS};

/// All `src` attributes of a page.
fn sources(page: &str) -> Vec<&str> {
    page.split("src=\"").skip(1).filter_map(|rest| rest.split('"').next()).collect()
}

/// Checks that a page refers to nothing outside itself and has one script.
#[track_caller]
pub(super) fn assert_self_contained(page: &str) {
    for word in ["http:", "https:", "url(", "@import", "<link", "<iframe", "<object", "href="] {
        assert!(!page.contains(word), "{word} is in the page");
    }
    for source in sources(page) {
        assert!(source.starts_with("data:image/"), "{}", &source[..source.len().min(80)]);
    }
    assert_eq!(page.matches("<script").count(), 1, "number of scripts");
    assert_eq!(
        page.matches("<img ").count(),
        sources(page).len(),
        "an image without an embedded source"
    );
    assert!(page.contains("default-src 'none'"), "the policy lets the browser fetch resources");
}

/// Decodes padded base64.
fn decode_base64(text: &str) -> Vec<u8> {
    const SYMBOLS: &str = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut bytes = Vec::new();
    for four in text.as_bytes().chunks(4) {
        let value = |&symbol: &u8| SYMBOLS.find(char::from(symbol)).unwrap_or(0) as u32;
        let word = four.iter().map(value).fold(0, |word, value| word << 6 | value);
        let padding = four.iter().filter(|&&symbol| symbol == b'=').count();
        bytes.extend_from_slice(&word.to_be_bytes()[1..4 - padding]);
    }
    bytes
}

fn picture(uri: &str) -> RgbImage {
    let (_, data) = uri.split_once(";base64,").expect("base64");
    image::load_from_memory(&decode_base64(data)).expect("a picture").into_rgb8()
}

/// PSNR of two images of equal size [dB].
fn psnr(a: &RgbImage, b: &RgbImage) -> f64 {
    assert_eq!(a.dimensions(), b.dimensions());
    let square = |(a, b): (&u8, &u8)| (f64::from(*a) - f64::from(*b)).powi(2);
    let mean = a.iter().zip(b.iter()).map(square).sum::<f64>() / a.len() as f64;
    10.0 * (255.0 * 255.0 / mean).log10()
}

fn report(runs: &[&Path], file: &Path, more: &str) -> Outcome {
    let runs = runs.iter().map(|run| text(run));
    let words: Vec<&str> = std::iter::once("report")
        .chain(runs)
        .chain(["-o", text(file), "--backend", "cpu"])
        .chain(more.split_whitespace())
        .collect();
    densify(&words)
}

fn train_run(scene: &Path, run: &Path, more: &str) {
    train(scene, run, 40, &format!("--budget 320 --eval --quiet {more}")).ok();
}

/// Copies a scene and renames its first photograph.
fn copy_scene(scene: &Photographs, to: PathBuf, renamed: &str) -> PathBuf {
    for (name, bytes) in files(scene.path()) {
        let path = to.join(name.replace("view_00.png", renamed));
        let text = String::from_utf8(bytes);
        let bytes = match text {
            Ok(text) => text.replace("view_00.png", renamed).into_bytes(),
            Err(error) => error.into_bytes(),
        };
        std::fs::create_dir_all(path.parent().expect("a folder")).expect("a folder");
        std::fs::write(path, bytes).expect("a copy");
    }
    to
}

#[test]
fn a_report_shows_the_results_and_is_self_contained() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train_run(scene.path(), &run, "--test-iterations 10,20,30");
    let file = root.path().join("new/report.html");
    let stdout = report(&[&run], &file, "").ok().stdout;
    assert!(stdout.contains("report   ") && stdout.contains("KiB"), "{stdout}");
    let page = read_text(&file);
    assert_self_contained(&page);
    assert!(page.len() < 400_000, "{} bytes of two small views", page.len());

    let score = &json(&run.join("results.json"))["ours_40"];
    let number = |key: &str, digits: usize| format!("{:.digits$}", score[key].as_f64().unwrap());
    let mut expected = vec![
        format!("{} dB", number("PSNR", 2)),
        number("SSIM", 4),
        number("FLIP", 4),
        "of at most 320".into(),
        "worst".into(),
        "best".into(),
        "the promise was kept".into(),
        "<p>None.</p>".into(),
        "sh_degree".into(),
        "min_opacity".into(),
    ];
    // The four curves: loss, Gaussians, test PSNR with dots, memory with the promise as a dashed line.
    expected.extend(["Loss", "PSNR of the test views", "the promised limit"].map(String::from));
    for words in &expected {
        assert!(page.contains(words.as_str()), "{words} is not in the report");
    }
    assert_eq!(page.matches("<figure class=\"curve\">").count(), 4);
    assert!(page.matches("<circle").count() >= 4 && page.matches("<polyline").count() >= 4);
    // The report contains no local paths.
    assert!(!page.contains(text(root.path())) && !page.contains(text(scene.path())));

    // Each of the two test views has a photograph, a rendering and a crop of each; the turntable frames follow.
    let sources = sources(&page);
    assert_eq!(sources.len(), 2 * 4 + 24);
    let pictures = root.path().join("pictures");
    call(&format!("render {} -o {} --backend cpu", text(&run), text(&pictures))).ok();
    let worst = page.split("<figcaption><strong>").nth(1).expect("a caption");
    let name = worst.split(".png").next().expect("a name");
    let photograph = image::open(scene.file(&format!("images/{name}.png"))).unwrap().into_rgb8();
    let render = image::open(pictures.join(format!("{name}.png"))).unwrap().into_rgb8();
    let [shown, rendered, crop] = [0, 1, 2].map(|at| picture(sources[at]));
    assert_eq!(shown.dimensions(), SIZE);
    assert!(psnr(&shown, &photograph) > 32.0, "{}", psnr(&shown, &photograph));
    assert!(psnr(&rendered, &render) > 32.0, "{}", psnr(&rendered, &render));
    assert_eq!(crop.dimensions(), (SIZE.0 / 4, SIZE.1 / 4));
    let turn: Vec<RgbImage> = sources[8..].iter().map(|uri| picture(uri)).collect();
    assert!(turn.windows(2).all(|pair| pair[0] != pair[1]), "the turntable does not move");

    // Reports are reproducible byte for byte and replace a file only with `--overwrite`.
    report(&[&run], &file, "").refused("again", &["-o", "exists", "--overwrite"]);
    report(&[&run], &file, "--overwrite --threads 1").ok();
    assert!(page == read_text(&file), "the report is not reproducible");
}

#[cfg(unix)]
#[test]
fn markup_in_names_is_escaped() {
    let evil = "<script>alert(1)<img src=x onerror=alert(2)>\"'&";
    let scene = Photographs::colmap_text();
    let root = tempfile::tempdir().expect("a folder");
    let scene = copy_scene(&scene, root.path().join(evil), "<i>\"&00.png");
    let run = root.path().join(format!("run{evil}"));
    densify(&[
        "train",
        text(&scene),
        "-o",
        text(&run),
        "--iterations",
        "20",
        "--eval",
        "--budget",
        "320",
        "--sh-degree",
        "1",
        "--quiet",
    ])
    .ok();
    let other = root.path().join("other");
    densify(&[
        "train",
        text(&scene),
        "-o",
        text(&other),
        "--config",
        text(&run.join("config.toml")),
        "--seed",
        "1",
        "--quiet",
    ])
    .ok();
    // Markup in the cause of a policy event and in an edited file.
    let log = run.join("stats/events.jsonl");
    let event = json!({ "step": 20, "before": 1, "removed": 0, "added": 0, "updated": 0, "denied": 0,
        "after": 1, "cause": "</td><script>alert(3)</script>\u{1b}[31m" });
    std::fs::write(&log, format!("{event}\n")).expect("a log");
    let left = json!({ "full": false, "left_out": [
        { "what": "<b>rows</b>", "evidence": "<u>some</u>", "loss": "none" }] });
    std::fs::write(run.join("stats/requirements.json"), left.to_string()).expect("a file");
    let file = root.path().join("report.html");
    report(&[&run, &other], &file, "").ok();
    let page = read_text(&file);
    assert_self_contained(&page);
    for markup in ["<img src=x", "<i>", "<b>", "<u>", "\u{1b}"] {
        assert!(!page.contains(markup), "{markup} is markup in the report");
    }
    for shown in [
        "&lt;script&gt;alert(1)&lt;img src=x onerror=alert(2)&gt;&quot;'&amp;",
        "<strong>&lt;i&gt;&quot;&amp;00.png</strong>",
        "&lt;/td&gt;&lt;script&gt;alert(3)&lt;/script&gt;\\u{1b}[31m",
        "<strong>&lt;b&gt;rows&lt;/b&gt;</strong>: &lt;u&gt;some",
    ] {
        assert!(page.contains(shown), "{shown} is not in the report");
    }
}

#[test]
fn reports_average_seeds_compare_policies_and_separate_scenes() {
    let scene = Photographs::colmap_text();
    let root = tempfile::tempdir().expect("a folder");
    let at = |name: &str| root.path().join(name);
    let mut runs = Vec::new();
    for policy in ["diet", "vanilla"] {
        for seed in 0..3 {
            let run = at(&format!("{policy}{seed}"));
            train_run(scene.path(), &run, &format!("--policy {policy} --seed {seed}"));
            runs.push(run);
        }
    }
    let file = at("seeds.html");
    let all: Vec<&Path> = runs.iter().map(PathBuf::as_path).collect();
    report(&all, &file, "").ok();
    let page = read_text(&file);
    assert_self_contained(&page);
    assert!(page.contains("report of 6 runs") && page.contains("Means over seeds"));
    // The mean over three seeds is shown with its interval.
    let psnr = |run: &Path| json(&run.join("results.json"))["ours_40"]["PSNR"].as_f64().unwrap();
    let mean = runs[..3].iter().map(|run| psnr(run)).sum::<f64>() / 3.0;
    assert!(page.contains(&format!("{mean:.2} [")), "{mean} is not in the report");
    let difference =
        (0..3).map(|seed| psnr(&runs[3 + seed]) - psnr(&runs[seed])).sum::<f64>() / 3.0;
    assert!(page.contains(&format!("{difference:+.2} [")), "{difference} is not in the report");
    // The first run of each policy can be selected for comparison.
    let choices = page
        .split("<select class=\"right\">")
        .nth(1)
        .and_then(|rest| rest.split("</select>").next());
    let choices: Vec<&str> = choices.expect("a choice").split("</option>").collect();
    assert_eq!(choices.len(), 4, "{choices:?}");
    assert!(choices[1].ends_with("diet0") && choices[2].ends_with("vanilla0"), "{choices:?}");
    assert_eq!(sources(&page).len(), 2 * (3 + 3) + 2 * 24);
    assert!(page.contains("<td>policy</td><td>diet</td>"), "the differing option is not listed");

    // Other photographs, and other splits of the same ones, count as separate scenes.
    let elsewhere = copy_scene(&scene, at("garden"), "view_00.png");
    train_run(&elsewhere, &at("garden-run"), "");
    train(&elsewhere, &at("garden-all"), 40, "--budget 320 --quiet --test-every 4").ok();
    let file = at("scenes.html");
    report(&[&runs[0], &at("garden-run"), &at("garden-all")], &file, "").ok();
    let page = read_text(&file);
    assert_self_contained(&page);
    for words in
        ["3 runs of 3 scenes", "Views of garden<", "Views of garden, read with other options (2)<"]
    {
        assert!(page.contains(words), "{words} is not in the report");
    }
    let file = at("moved.html");
    let refused =
        report(&[&runs[0], &at("garden-run")], &file, &format!("--scene {}", text(scene.path())));
    refused.refused("two scenes, one folder", &["--scene", "garden"]);
    assert!(!file.exists());
}

#[test]
fn runs_without_test_views_show_training_views() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train(scene.path(), &run, 20, "--budget 320 --quiet").ok();
    let file = root.path().join("report.htm");
    // The dataset is moved after training.
    let moved = copy_scene(&scene, root.path().join("moved"), "view_00.png");
    drop(scene);
    report(&[&run], &file, "").refused("it has moved", &["--scene"]);
    report(&[&run], &file, &format!("--scene {}", text(&moved))).ok();
    let page = read_text(&file);
    assert_self_contained(&page);
    for words in
        ["No view was held out", &format!("{VIEWS} training views"), "second worst", "--eval"]
    {
        assert!(page.contains(words), "{words} is not in the report");
    }
    assert_eq!(sources(&page).len(), 4 * 4 + 24);
}

#[test]
fn invalid_reports_are_refused_with_a_remedy() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train_run(scene.path(), &run, "");
    let file = root.path().join("report.html");
    let at = |name: &str| root.path().join(name);
    std::fs::create_dir(at("empty")).expect("a folder");
    let unsaved = at("unsaved");
    super::copy_unfinished(&run, &unsaved, 40);
    let model = densify::train::output::model_path(&run, 40);
    for (runs, more, expected) in [
        (vec![&*at("empty")], "", vec!["empty", "holds no run", "config.toml"]),
        (vec![Path::new("nowhere")], "", vec!["nowhere does not exist"]),
        (vec![&*unsaved], "", vec!["unsaved", "no saved model"]),
        (vec![&*model], "", vec!["point_cloud.ply", "a model", "densify train"]),
        (vec![&*run, &*run], "", vec!["named twice"]),
        (vec![&*run], "--iteration 7", vec!["--iteration 7", "40"]),
        (vec![&*run], "--scene nowhere", vec!["nowhere"]),
    ] {
        report(&runs, &file, more).refused(&format!("{runs:?} {more}"), &expected);
    }
    report(&[&run], &at("report.pdf"), "").refused("no HTML", &["-o", "report.pdf", ".html"]);
    report(&[&run], &at("empty"), "").refused("a folder", &["-o", ".html"]);
    std::fs::create_dir(at("folder.html")).expect("a folder");
    report(&[&run], &at("folder.html"), "--overwrite").refused("a folder", &["is a folder"]);
    assert!(!densify(&["report", text(&run)]).stderr.is_empty(), "-o is needed");
    // A log that was changed by hand.
    let log = run.join("stats/train.jsonl");
    let sound = read(&log);
    std::fs::write(&log, [&sound[..], b"{\"step\": true}\n"].concat()).expect("a log");
    report(&[&run], &file, "").refused("a bad line", &["train.jsonl", "line 5", "by hand"]);
    std::fs::write(run.join("results.json"), r#"{"theirs": {}}"#).expect("scores");
    std::fs::write(&log, sound).expect("a log");
    report(&[&run], &file, "").refused("strange scores", &["results.json", "theirs"]);
    assert!(!file.exists(), "a report was written");
}

/// Reports of a run in progress show its last saved state.
#[cfg(unix)]
#[test]
fn a_run_in_progress_is_reported_as_last_saved() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train_run(scene.path(), &run, "--save-iterations 20 --test-iterations 20");
    let so_far = root.path().join("so-far");
    super::copy_unfinished(&run, &so_far, 40);
    // The last line is incomplete, as in a log that is being written.
    let log = so_far.join("stats/train.jsonl");
    std::fs::write(&log, [&read(&log)[..], b"{\"step\": 50, \"lo"].concat()).expect("a log");
    let lock = std::fs::File::create(so_far.join("densify.lock")).expect("a file");
    lock.lock().expect("a lock");
    let file = root.path().join("report.html");
    let stdout = report(&[&so_far], &file, "").ok().stdout;
    assert!(stdout.contains("is being trained"), "{stdout}");
    let page = read_text(&file);
    assert!(
        page.contains("is being trained and has reached iteration 40 of 40"),
        "the page does not say that the run is in progress"
    );
    assert!(page.contains("model of iteration 20."));
    assert!(!page.contains("promise was kept"), "the report judges an unfinished run");
    let score = json(&so_far.join("results.json"))["ours_20"]["PSNR"].as_f64().unwrap();
    assert!(page.contains(&format!("{score:.2} dB")), "{score}");
    std::fs::remove_dir_all(so_far.join("point_cloud")).expect("models");
    report(&[&so_far], &file, "--overwrite")
        .refused("nothing is saved", &["is being trained", "--save-iterations"]);
    assert_eq!(page, read_text(&file), "the older report is gone");
}
