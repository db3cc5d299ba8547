//! `train --view`: the page that shows a run in progress and controls it; viewing does not affect training.

use std::io::Read;
use std::net::TcpStream;
use std::path::Path;
use std::thread;

use serde_json::{Value, json};

use super::view_server::{Page, frame_request};
use super::{call, count, json, model, read, read_text, records, resume, scratch, text, train};
use crate::photographs::{Photographs, SIZE};

/// Enough iterations to pause a run before its end.
const ITERATIONS: u32 = 1_500;

fn watched(scene: &Path, run: &Path, flags: &str) -> Page {
    let fixed = format!("--sh-degree 1 --iterations {ITERATIONS} --budget 320 --backend cpu");
    Page::start(&format!("train {} -o {} --view {fixed} {flags}", text(scene), text(run)))
}

impl Page {
    fn order(&self, order: &str) {
        let reply = self.try_post("order", "", &json!({ "order": order }).to_string());
        let reply = reply.expect("a reply");
        assert_eq!(reply.status, 200, "{}", reply.text());
    }

    fn progress(&self) -> Value {
        let reply = self.get(&format!("{}progress", self.path));
        serde_json::from_slice(&reply.body).unwrap_or_else(|e| panic!("{e}: {}", reply.text()))
    }

    /// Waits until the run is paused and returns its step.
    fn wait_for_pause(&self) -> u64 {
        loop {
            let now = self.progress();
            // After the order "step", the state is "paused" before the step is taken, so the step is read twice.
            if now["state"] == "paused" && self.progress()["step"] == now["step"] {
                return count(&now, "step");
            }
            thread::yield_now();
        }
    }

    /// Waits for the end of the program; returns its exit code and output.
    fn wait_for_end(mut self) -> (Option<i32>, String) {
        let mut output = String::new();
        self.stdout.read_to_string(&mut output).expect("text");
        let mut errors = self.program.stderr.take().expect("a pipe");
        errors.read_to_string(&mut output).expect("text");
        (self.program.wait().expect("the program ends").code(), output)
    }
}

/// A request for a frame while the camera orbits the scene.
fn moving_request(at: u32) -> Value {
    let (sine, cosine) = (f64::from(at) * 0.1).sin_cos();
    let pose = [
        [cosine, 0.0, sine, 4.0 * sine],
        [0.0, 1.0, 0.0, 0.0],
        [-sine, 0.0, cosine, 4.0 * cosine],
        [0.0, 0.0, 0.0, 1.0],
    ];
    let camera = json!({ "camera_to_world": pose.as_flattened(), "fov": 50 });
    json!({ "page": "moving", "kind": "render", "width": 640, "height": 480, "moving": true, "camera": camera })
}

#[test]
fn viewers_do_not_change_a_byte_of_the_run() {
    let scene = Photographs::colmap_text();
    // A policy that reads signals, one that adds noise, and one that renders auxiliary views.
    for policy in ["diet", "mcmc", "taming"] {
        let flags =
            format!("--policy {policy} --eval --test-iterations 500 --checkpoint-every 600");
        let (_root, alone) = scratch();
        train(
            scene.path(),
            &alone,
            ITERATIONS,
            &format!("--budget 320 --quiet --backend cpu {flags}"),
        )
        .ok();
        let (_root, viewed) = scratch();
        let page = watched(scene.path(), &viewed, &flags);
        page.order("pause");
        let first = page.wait_for_pause();
        assert!(first < u64::from(ITERATIONS), "the run has ended before it could be paused");
        // A paused model does not change; a step changes it.
        let frame = || page.frame(&frame_request("render", "test", 0, SIZE)).body;
        let before = frame();
        assert!(before == frame(), "{policy}: the paused model changes");
        page.order("step");
        while count(&page.progress(), "step") == first {
            thread::yield_now();
        }
        assert_eq!(page.wait_for_pause(), first + 1, "{policy}: not exactly one step");
        assert!(before != frame(), "{policy}: a step changes nothing");
        page.order("checkpoint");
        let kept = viewed.join(format!("checkpoints/iteration_{}.safetensors", first + 1));
        while !kept.is_file() {
            thread::yield_now();
        }
        page.order("continue");
        // From here on, frames of every kind are requested until the run ends.
        let mut pictures = 0;
        let mut kinds = vec!["render", "depth", "opacity", "count", "difference", "photograph"];
        kinds.extend(["rows", "row_opacity", "row_size", "row_shape", "row_age", "row_edit"]);
        // Kinds that the policy measures.
        kinds.extend((policy != "mcmc").then_some("row_gradient"));
        kinds.extend((policy == "diet").then_some("row_weight"));
        for at in 0.. {
            let request = match at % 3 {
                0 => frame_request(kinds[at as usize / 3 % kinds.len()], "test", 1, SIZE),
                _ => moving_request(at),
            };
            match page.try_post("frame", "", &request.to_string()) {
                Some(reply) if reply.status == 200 => {
                    // No frame exceeds the size that the memory promise covers.
                    let (width, height) = reply.picture().dimensions();
                    assert!(width <= SIZE.0 && height <= SIZE.1, "{width}x{height}");
                    pictures += 1;
                }
                _ => break,
            }
        }
        assert!(pictures > 100, "{policy}: only {pictures} frames");
        let (code, output) = page.wait_for_end();
        assert_eq!(code, Some(0), "{output}");
        assert!(
            model(&viewed, ITERATIONS) == model(&alone, ITERATIONS),
            "{policy}: the models differ"
        );
        let same =
            ["stats/events.jsonl", "results.json", "per_view.json", "config.toml", "cameras.json"];
        for name in same {
            assert!(
                read(&viewed.join(name)) == read(&alone.join(name)),
                "{policy}: {name} differs"
            );
        }
        let losses = |run: &Path| -> Vec<Value> {
            records(&run.join("stats/train.jsonl"))
                .iter()
                .map(|step| step["loss"].clone())
                .collect()
        };
        assert_eq!(losses(&viewed), losses(&alone), "{policy}: the losses differ");
        // Viewing stayed within the promised memory.
        let summary = json(&viewed.join("stats/summary.json"));
        let lines = summary["ledger"]["lines"].as_array().expect("lines");
        for name in ["the page", "a picture for the page"] {
            assert!(lines.iter().any(|line| line["what"] == name), "{name} is not in the ledger");
        }
        if let Some(peak) = summary["peak_bytes"].as_u64() {
            assert!(peak <= count(&summary, "ledger_bytes"), "{policy}: {summary}");
        }
    }
}

#[test]
fn the_page_reports_progress() {
    let scene = Photographs::colmap_text();
    let (_root, run) = scratch();
    let page = watched(scene.path(), &run, "--eval --test-iterations 100");
    while page.progress()["tests"].as_array().is_none_or(Vec::is_empty) {
        thread::yield_now();
    }
    page.order("pause");
    let step = page.wait_for_pause();
    let now = page.progress();
    assert_eq!((&now["last"], &now["budget"]), (&ITERATIONS.into(), &320.into()), "{now}");
    let points = now["points"].as_array().expect("points");
    assert_eq!(points.len() as u64, step / 10, "{now}");
    let log = records(&run.join("stats/train.jsonl"));
    for (point, record) in points.iter().zip(&log) {
        for key in ["step", "loss", "rows"] {
            assert_eq!(point[key], record[key], "{key}");
        }
    }
    let edits = now["edits"].as_array().expect("edits");
    let events = records(&run.join("stats/events.jsonl"));
    assert!(!edits.is_empty() && *edits == events[events.len() - edits.len()..], "{now}");
    let psnr = json(&run.join("results.json"))["ours_100"]["PSNR"].clone();
    assert_eq!(now["tests"], json!([[100, psnr]]), "{now}");
    let described: Value =
        serde_json::from_slice(&page.get(&format!("{}scene", page.path)).body).expect("JSON");
    assert_eq!(described["live"], true);
    let kinds: Vec<&str> = described["kinds"]
        .as_array()
        .into_iter()
        .flatten()
        .filter_map(|kind| kind["kind"].as_str())
        .collect();
    assert_eq!(kinds.len(), 14, "{kinds:?}");
    assert!(
        described["points"]["positions"].as_array().is_some_and(|positions| !positions.is_empty())
    );
    let range = |kind: &str| {
        let reply = page.frame(&frame_request(kind, "test", 0, SIZE));
        let range = reply.header("X-Range").expect("a range").to_owned();
        let (least, most) = range.split_once(' ').expect("two numbers");
        [least, most].map(|end| end.parse::<f64>().expect("a number"))
    };
    // Some Gaussians are as old as the run, and some were edited later.
    let [age, edit] = ["row_age", "row_edit"].map(|kind| range(kind)[1]);
    assert!(edit <= age && age <= step as f64 && age > 0.0, "{age} {edit} {step}");
    let [least, most] = range("row_gradient");
    assert!(0.0 < least && least < most && most < 1.0, "{least} {most}");

    // Kinds that the policy does not measure are missing, with the reason.
    let (_root, other) = scratch();
    let quiet = watched(scene.path(), &other, "--policy mcmc --eval");
    let described: Value =
        serde_json::from_slice(&quiet.get(&format!("{}scene", quiet.path)).body).expect("JSON");
    let lacking: Vec<&Value> = described["lacking"].as_array().into_iter().flatten().collect();
    let names_policy =
        |lacking: &&&Value| lacking["why"].as_str().is_some_and(|why| why.contains("mcmc"));
    let by_policy = lacking.iter().filter(names_policy).count();
    // The weight in front of the surface is measured for finished models only.
    assert_eq!((lacking.len(), by_policy), (3, 2), "{lacking:?}");
    let refused = quiet.frame(&frame_request("row_gradient", "test", 0, SIZE));
    assert!(refused.status == 400 && refused.text().contains("mcmc"), "{}", refused.text());
    drop(quiet);

    // A stopped run leaves a checkpoint and resumes to the same model.
    page.order("stop");
    let (code, output) = page.wait_for_end();
    assert_eq!(code, Some(130), "{output}");
    let words = format!("stopped by the page after step {step}");
    assert!(output.contains(&words) && output.contains("--resume"), "{output}");
    let (_root, whole) = scratch();
    let flags = "--budget 320 --eval --test-iterations 100 --quiet --backend cpu";
    train(scene.path(), &whole, ITERATIONS, flags).ok();
    resume(scene.path(), &run, "--quiet").ok();
    assert!(model(&run, ITERATIONS) == model(&whole, ITERATIONS), "the models differ");
}

#[test]
fn foreign_requests_and_idle_connections_do_not_affect_training() {
    let scene = Photographs::colmap_text();
    let (_root, run) = scratch();
    let page = watched(scene.path(), &run, "");
    assert_eq!(page.path.trim_matches('/').len(), 32, "{}", page.path);
    page.order("pause");
    let step = page.wait_for_pause();
    let stop = json!({ "order": "stop" }).to_string();
    let send_stop = |path: &str, more: &str| {
        let whole = format!("{path}order");
        let request = format!(
            "POST {whole} HTTP/1.1\r\nHost: {}\r\nConnection: close\r\nContent-Length: {}\r\n{more}\r\n{stop}",
            page.place,
            stop.len()
        );
        page.send(request.as_bytes()).status
    };
    let json = "Content-Type: application/json\r\n";
    let wrong = format!("/{}/", "0".repeat(32));
    for (path, more, status) in [
        ("/", json.to_owned(), 404),
        (&*wrong, json.to_owned(), 404),
        (&*page.path, format!("{json}Origin: http://evil.example\r\n"), 403),
        (&*page.path, format!("{json}Origin: null\r\n"), 403),
        (&*page.path, "Content-Type: text/plain\r\n".to_owned(), 415),
    ] {
        assert_eq!(send_stop(path, &more), status, "{path} {more}");
    }
    for order in ["{}", "{\"order\": \"explode\"}", "{\"order\": \"stop\", \"path\": \"/\"}"] {
        assert_eq!(page.try_post("order", "", order).expect("a reply").status, 400, "{order}");
    }
    assert_eq!(page.get(&format!("{}order", page.path)).status, 405);
    // Malformed and oversized requests are refused, too.
    let place = &page.place;
    let head = format!("POST {}order HTTP/1.1\r\nHost: {place}\r\n{json}", page.path);
    for (request, status) in [
        (b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n\r\n".to_vec(), 400),
        (format!("GET /{} HTTP/1.1\r\n", "a".repeat(9000)).into_bytes(), 431),
        (format!("{head}Content-Length: 99999999999\r\n\r\n").into_bytes(), 413),
        (format!("{head}Transfer-Encoding: chunked\r\n\r\n5\r\n").into_bytes(), 411),
    ] {
        let shown = String::from_utf8_lossy(&request[..request.len().min(60)]).into_owned();
        assert_eq!(page.send(&request).status, status, "{shown}");
    }
    let now = page.progress();
    assert_eq!(
        (&now["state"], count(&now, "step")),
        (&"paused".into(), step),
        "a foreign request took effect"
    );
    // A thousand idle connections stay within the promised memory, and training completes.
    let idle: Vec<TcpStream> = (0..1000).map(|_| page.connect()).collect();
    page.order("continue");
    let (code, output) = page.wait_for_end();
    drop(idle);
    assert_eq!(code, Some(0), "{output}");
    let (_root, alone) = scratch();
    train(scene.path(), &alone, ITERATIONS, "--budget 320 --quiet --backend cpu").ok();
    assert!(model(&run, ITERATIONS) == model(&alone, ITERATIONS), "the models differ");
    let summary = super::json(&run.join("stats/summary.json"));
    if let Some(peak) = summary["peak_bytes"].as_u64() {
        assert!(peak <= count(&summary, "ledger_bytes"), "{summary}");
    }
}

#[test]
fn invalid_addresses_are_refused_before_writing() {
    let scene = Photographs::colmap_text();
    let (_root, run) = scratch();
    let taken = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
    let port = taken.local_addr().expect("an address").port();
    for (flag, words) in [
        (format!("--view={port}"), vec![format!("--view={port}: another program")]),
        ("--view=70000".to_owned(), vec!["--view".to_owned()]),
        ("--view=here".to_owned(), vec!["--view".to_owned()]),
    ] {
        let words: Vec<&str> = words.iter().map(String::as_str).collect();
        train(scene.path(), &run, 40, &flag).refused(&flag, &words);
        assert!(!run.exists(), "{flag}");
    }
    // `plan` includes the memory of the page.
    let plan = |flag: &str| {
        call(&format!("plan {} --budget 320 --backend cpu {flag}", text(scene.path()))).ok().stdout
    };
    assert!(plan("--view").contains("the page") && !plan("").contains("the page"));
    // The option is not recorded in the run.
    train(scene.path(), &run, 10, "--budget 320 --view --quiet --backend cpu").ok();
    assert!(!read_text(&run.join("config.toml")).contains("\nview = "));
}
