//! `densify eval`, `render`, `policies` and `selftest`: commands that inspect models, policies and backends.

use std::path::Path;

use safetensors::tensor::{Dtype, TensorView};

use super::{call, files, json, scratch, text, train};
use crate::photographs::{Photographs, SIZE, VIEWS, name};

pub(super) const ITERATIONS: u32 = 40;

pub(super) fn train_run(scene: &Photographs, run: &Path) {
    train(scene.path(), run, ITERATIONS, "--budget 320 --eval --quiet").ok();
}

/// Checks that two JSON documents are equal, with numbers compared up to `tolerance`.
fn assert_close(a: &serde_json::Value, b: &serde_json::Value, tolerance: f64) {
    use serde_json::Value::{Number, Object};
    match (a, b) {
        (Object(a), Object(b)) => {
            assert!(a.keys().eq(b.keys()), "{a:?} and {b:?} have different keys");
            a.values().zip(b.values()).for_each(|(a, b)| assert_close(a, b, tolerance));
        }
        (Number(a), Number(b)) => {
            let [a, b] = [a, b].map(|n| n.as_f64().expect("a number"));
            assert!((a - b).abs() <= tolerance, "{a} is not {b}");
        }
        _ => assert_eq!(a, b),
    }
}

#[test]
fn eval_reproduces_the_scores_of_training() {
    let scene = Photographs::colmap_text();
    let (_root, run) = scratch();
    train_run(&scene, &run);
    let paths = ["results.json", "per_view.json"].map(|name| run.join(name));
    let trained = paths.clone().map(|path| json(&path));
    paths.iter().for_each(|path| std::fs::remove_file(path).expect("an existing file"));
    let outcome = call(&format!("eval {}", text(&run))).ok();
    // Values are rounded when the model file stores them in the dataset's coordinates.
    for (path, trained) in paths.iter().zip(&trained) {
        assert_close(&json(path), trained, 2e-3);
    }
    for view in [0, 8] {
        assert!(outcome.stdout.contains(&name(view)), "{}", outcome.stdout);
    }
    assert!(outcome.stdout.contains("mean"), "{}", outcome.stdout);

    call(&format!("eval {} --split train", text(&run))).ok();
    let views = &json(&run.join("per_view_train.json"))["ours_40"]["PSNR"];
    assert_eq!(views.as_object().map(serde_json::Map::len), Some(VIEWS - 2));
    assert_close(&json(&run.join("results.json")), &trained[0], 2e-3);
}

/// Writes arbitrary weights in the shape of AlexNet.
fn write_weights(path: &Path) {
    let layers = [(1, 0, 64, 3, 11), (2, 3, 192, 64, 5), (3, 6, 384, 192, 3), (4, 8, 256, 384, 3)];
    let layers = layers.into_iter().chain([(5, 10, 256, 256, 3)]);
    let mut arrays: Vec<(String, Vec<usize>)> = Vec::new();
    for (stage, number, outputs, inputs, side) in layers {
        let name = format!("net.slice{stage}.{number}");
        arrays.push((format!("{name}.weight"), vec![outputs, inputs, side, side]));
        arrays.push((format!("{name}.bias"), vec![outputs]));
        arrays.push((format!("lin{}.model.1.weight", stage - 1), vec![1, outputs, 1, 1]));
    }
    let value = |i: usize| (0.001 * (i * 37 % 101) as f32 - 0.03).to_le_bytes();
    let bytes = arrays.iter().map(|(_, shape)| (0..shape.iter().product()).flat_map(value));
    let bytes: Vec<Vec<u8>> = bytes.map(Iterator::collect).collect();
    let views = arrays.iter().zip(&bytes).map(|((name, shape), bytes)| {
        let view = TensorView::new(Dtype::F32, shape.clone(), bytes);
        (name, view.expect("bytes that match the shape"))
    });
    safetensors::serialize_to_file(views, None, path).expect("a file is written");
}

#[test]
fn eval_measures_lpips_with_the_users_weights() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train_run(&scene, &run);
    let file = root.path().join("alex.safetensors");
    write_weights(&file);
    let call_with = |file: &Path, more: &str| {
        call(&format!("eval {} --lpips {} {more}", text(&run), text(file)))
    };
    let outcome = call_with(&file, "--fail-above lpips=100").ok();
    assert!(outcome.stdout.contains("LPIPS"), "{}", outcome.stdout);
    let mean = json(&run.join("results.json"))["ours_40"]["LPIPS"].as_f64();
    let views = json(&run.join("per_view.json"))["ours_40"]["LPIPS"].clone();
    let views: Vec<f64> =
        views.as_object().into_iter().flatten().map(|v| v.1.as_f64().unwrap()).collect();
    assert_eq!(views.len(), 2);
    assert!(views.iter().all(|&value| value > 0.0), "{views:?}");
    assert!((mean.unwrap() - 0.5 * (views[0] + views[1])).abs() < 1e-12, "{mean:?}");
    let beyond = call_with(&file, "--fail-above lpips=0");
    assert!(beyond.code == Some(4) && beyond.stderr.contains("lpips is"), "{beyond:?}");
    // Without the weights there is no LPIPS.
    call(&format!("eval {}", text(&run))).ok();
    assert!(json(&run.join("results.json"))["ours_40"].get("LPIPS").is_none());
    let without = call(&format!("eval {} --fail-above lpips=1", text(&run)));
    without.refused("no weights are given", &["lpips", "--lpips FILE"]);
    std::fs::write(&file, "no weights").unwrap();
    let words = ["--lpips", "alex.safetensors", "not a safetensors file", "docs/metrics.md"];
    call_with(&file, "").refused("no weights are in the file", &words);
}

/// The size of an image [px].
pub(super) fn size(folder: &Path, name: &str) -> (u32, u32) {
    let path = folder.join(name);
    image::image_dimensions(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

#[test]
fn render_writes_images_of_the_views() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train_run(&scene, &run);
    let pictures = root.path().join("pictures");
    let all = "--alpha --depth --side-by-side";
    call(&format!("render {} -o {} {all}", text(&run), text(&pictures))).ok();
    let names: Vec<String> = files(&pictures).into_keys().collect();
    let maps = |view: &str| {
        ["alpha", "depth", "pair"].map(|kind| format!("{view}.{kind}.png")).into_iter()
    };
    let mut expected: Vec<String> = maps("view_00").chain(maps("view_08")).collect();
    let arrays = ["view_00.depth.npy", "view_08.depth.npy"];
    expected.extend(["view_00.png", "view_08.png", "depth.json"].map(str::to_owned));
    expected.extend(arrays.map(str::to_owned));
    expected.sort();
    assert_eq!(names, expected);
    for kind in ["png", "alpha.png", "depth.png"] {
        assert_eq!(size(&pictures, &format!("view_00.{kind}")), SIZE, "{kind}");
    }
    assert_eq!(size(&pictures, "view_08.pair.png"), (2 * SIZE.0, SIZE.1));
    let open = |name: &str| image::open(pictures.join(name)).expect("a picture");
    let image::DynamicImage::ImageLuma16(steps) = open("view_00.depth.png") else {
        panic!("depth has sixteen bits");
    };
    // The scene has opaque blobs four dataset units away.
    let unit = json(&pictures.join("depth.json"))["unit"]["view_00.depth.png"].as_f64();
    let unit = unit.expect("a number");
    let array = std::fs::read(pictures.join(arrays[0])).unwrap();
    let values = &array[array.len() - 4 * steps.len()..];
    let values = values.chunks_exact(4).map(|z| f32::from_le_bytes([z[0], z[1], z[2], z[3]]));
    let mut largest = 0.0_f64;
    for (step, value) in steps.as_raw().iter().zip(values.map(f64::from)) {
        assert!((f64::from(*step) * unit - value).abs() <= 0.51 * unit, "{step} for {value}");
        largest = largest.max(value);
    }
    assert!((3.0..6.0).contains(&largest), "{largest}");
    // The median depth is that of one Gaussian, not a mean.
    let median = root.path().join("median");
    let words = format!("render {} -o {} --depth --depth-kind median", text(&run), text(&median));
    call(&format!("{words} --backend gpu")).refused("a GPU", &["--backend", "processor"]);
    call(&words).ok();
    assert_eq!(json(&median.join("depth.json"))["kind"], "median");
    assert_eq!(json(&pictures.join("depth.json"))["kind"], "expected");
    assert!(std::fs::read(median.join(arrays[0])).unwrap() != array);
    // The pair shows the photograph on the left and the rendering on the right.
    let pair = open("view_00.pair.png").into_rgb8();
    let (photograph, rendering) = (
        image::open(scene.file("images/view_00.png")).unwrap().into_rgb8(),
        open("view_00.png").into_rgb8(),
    );
    for (x, y, pixel) in pair.enumerate_pixels() {
        let (image, x) = if x < SIZE.0 { (&photograph, x) } else { (&rendering, x - SIZE.0) };
        assert_eq!(pixel, image.get_pixel(x, y));
    }

    let train = root.path().join("train");
    for flag in ["-r 1", "--background white", "--near 0.1"] {
        let words = ["is for a file", "a run brings its own"];
        call(&format!("render {} -o {} {flag}", text(&run), text(&pictures))).refused(flag, &words);
    }
    let limits = "--fail-below psnr=99 --fail-above flip=1";
    let failed = call(&format!("eval {} {limits}", text(&run)));
    assert_eq!(failed.code, Some(4), "{failed:?}");
    assert!(failed.stderr.contains("beyond --fail-below psnr=99"), "{failed:?}");
    call(&format!("eval {} --fail-below psnr=1 --fail-below ssim=0", text(&run))).ok();
    call(&format!("render {} -o {} --split train", text(&run), text(&train))).ok();
    assert_eq!(files(&train).len(), VIEWS - 2);
}

/// A run brings its own near plane, so a command that only measures it does not tell the user to give another.
#[test]
fn the_near_plane_of_a_run_is_announced_only_when_it_trains() {
    let scene = Photographs::colmap_text();
    let (_root, run) = scratch();
    let outcome = train(scene.path(), &run, 2, "--budget 320 --eval --near 0.999").ok();
    assert!(outcome.stdout.contains("nearer than --near 0.999"), "{outcome:?}");
    let outcome = call(&format!("eval {} --backend cpu", text(&run))).ok();
    assert!(!outcome.stdout.contains("--near"), "{outcome:?}");
}

#[test]
fn a_bare_model_renders_like_its_run() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train_run(&scene, &run);
    let render = |words: &str, to: &str| {
        let to = root.path().join(to);
        (call(&format!("render {words} -o {}", text(&to))), to)
    };
    let ply = densify::train::output::model_path(&run, ITERATIONS);
    let (ply, dataset) = (text(&ply), text(scene.path()));
    let (run_outcome, run_images) = render(text(&run), "a");
    let (file_outcome, file_images) = render(&format!("{ply} --scene {dataset} --eval"), "b");
    run_outcome.ok();
    file_outcome.ok();
    assert!(files(&run_images) == files(&file_images));
    let (refused, nowhere) = render(ply, "c");
    refused.refused("no cameras", &["--scene"]);
    assert!(!nowhere.exists());
}

#[test]
fn selftest_prints_and_writes_its_figures() {
    let (root, _) = scratch();
    let file = root.path().join("deep/figures.md");
    let outcome = call(&format!("selftest --backend cpu 1 16 --markdown {}", text(&file))).ok();
    for words in
        ["on native", "no Gaussian", "ok", "depths one bit apart", "within their tolerances"]
    {
        assert!(outcome.stdout.contains(words), "{words}: {}", outcome.stdout);
    }
    let written = std::fs::read_to_string(&file).expect("a written file");
    assert!(written.contains("## native") && written.contains("| 16 | depths"), "{written}");
    call("selftest 99").refused("no such case", &["no case 99", "30"]);
    call("selftest --all --gpu x").refused("two choices", &["--all"]);
}

#[test]
fn policies_are_listed_and_explained() {
    let list = call("policies").ok().stdout;
    for entry in densify_policies::registry::policies().expect("the registry is sound") {
        assert!(list.contains(entry.name) && list.contains(entry.summary), "{list}");
        let manual = call(&format!("policies {}", entry.name)).ok().stdout;
        for (parameter, _) in entry.parameters() {
            let set = format!("--policy-set {}.{parameter}=", entry.name);
            assert!(manual.contains(&set), "{set} is not in {manual}");
        }
        assert!(manual.contains(entry.manual().lines().next().unwrap_or("?")), "{manual}");
    }
    call("policies diett").refused("misspelt", &["diett", "diet"]);
    call("policies show diet").refused("a word too many", &["`densify policies diet`"]);
}
