//! `densify view`: the server over plain TCP, refused requests, and shutdown. One file, because all tests share the
//! helpers `Page` and `Reply`.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, ChildStdout, Command, Stdio};
use std::time::Duration;

use image::RgbImage;
use serde_json::{Value, json};

use super::{WITHOUT_GPU, call, json, scratch, text, train};
use crate::photographs::{Photographs, SIZE};

/// A running program that serves the viewer page.
pub(super) struct Page {
    pub(super) program: Child,
    pub(super) stdout: BufReader<ChildStdout>,
    /// Address and port.
    pub(super) place: String,
    /// Base path of all requests: `/` or `/SECRET/`.
    pub(super) path: String,
    /// Output before the line with the address.
    before: String,
}

/// An HTTP reply.
#[derive(Debug)]
pub(super) struct Reply {
    pub(super) status: u16,
    head: String,
    pub(super) body: Vec<u8>,
}

impl Reply {
    pub(super) fn text(&self) -> String {
        String::from_utf8_lossy(&self.body).into_owned()
    }

    /// The value of a header.
    pub(super) fn header(&self, name: &str) -> Option<&str> {
        let mut lines = self.head.lines().filter_map(|line| line.split_once(": "));
        lines.find(|(key, _)| *key == name).map(|(_, value)| value)
    }

    pub(super) fn picture(&self) -> RgbImage {
        assert_eq!(self.status, 200, "{}", self.text());
        let format = image::ImageFormat::Jpeg;
        image::load_from_memory_with_format(&self.body, format).expect("a JPEG").into_rgb8()
    }
}

impl Page {
    fn open(words: &str) -> Self {
        Self::start(&format!("view {words} --port 0 --backend cpu"))
    }

    /// Starts a command that serves a page and waits for its address.
    pub(super) fn start(command: &str) -> Self {
        let mut program = Command::new(env!("CARGO_BIN_EXE_densify"))
            .envs([WITHOUT_GPU])
            .args(command.split_whitespace())
            .env_remove("RUST_LOG")
            .env("XDG_CACHE_HOME", env!("CARGO_TARGET_TMPDIR"))
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .expect("the program starts");
        let mut stdout = BufReader::new(program.stdout.take().expect("a pipe"));
        let (mut line, mut before) = (String::new(), String::new());
        while !line.starts_with("page ") {
            before.push_str(&line);
            line.clear();
            let length = stdout.read_line(&mut line).expect("text");
            assert!(length > 0, "the program has ended: {:?}", program.wait());
        }
        let url = line.trim_start_matches("page").trim();
        let rest = url.strip_prefix("http://").expect("an address");
        let (place, path) = rest.split_once('/').expect("a path");
        Self { program, stdout, place: place.to_owned(), path: format!("/{path}"), before }
    }

    pub(super) fn connect(&self) -> TcpStream {
        let stream = TcpStream::connect(&self.place).expect("a connection");
        stream.set_read_timeout(Some(Duration::from_secs(60))).expect("a time");
        stream
    }

    /// Sends bytes and reads until the connection is closed.
    pub(super) fn send(&self, request: &[u8]) -> Reply {
        self.try_send(request).expect("a reply")
    }

    /// Like `send`; returns `None` if the program has ended.
    fn try_send(&self, request: &[u8]) -> Option<Reply> {
        let mut stream = TcpStream::connect(&self.place).ok()?;
        stream.set_read_timeout(Some(Duration::from_secs(60))).ok()?;
        stream.write_all(request).ok()?;
        let mut bytes = Vec::new();
        stream.read_to_end(&mut bytes).ok()?;
        let end = bytes.windows(4).position(|four| four == b"\r\n\r\n")? + 4;
        let head = String::from_utf8(bytes[..end].to_vec()).expect("a head is text");
        let status = head.split(' ').nth(1).and_then(|word| word.parse().ok());
        Some(Reply { status: status.expect("a status"), body: bytes.split_off(end), head })
    }

    pub(super) fn get(&self, path: &str) -> Reply {
        let Self { place, .. } = self;
        self.send(
            format!("GET {path} HTTP/1.1\r\nHost: {place}\r\nConnection: close\r\n\r\n").as_bytes(),
        )
    }

    fn post(&self, more: &str, body: &str) -> Reply {
        self.try_post("frame", more, body).expect("a reply")
    }

    /// Posts JSON to an endpoint; returns `None` if the program has ended.
    pub(super) fn try_post(&self, endpoint: &str, more: &str, body: &str) -> Option<Reply> {
        let Self { place, path, .. } = self;
        let request = format!(
            "POST {path}{endpoint} HTTP/1.1\r\nHost: {place}\r\nConnection: close\r\n\
             Content-Type: application/json\r\nContent-Length: {}\r\n{more}\r\n{body}",
            body.len()
        );
        self.try_send(request.as_bytes())
    }

    pub(super) fn frame(&self, request: &Value) -> Reply {
        self.post("", &request.to_string())
    }

    /// Ends the program like Ctrl-C and returns its remaining output.
    #[cfg(unix)]
    fn end(mut self) -> String {
        let pid = self.program.id().to_string();
        let sent = Command::new("kill").args(["-INT", &pid]).status().expect("`kill` can be run");
        assert!(sent.success());
        let mut rest = String::new();
        self.stdout.read_to_string(&mut rest).expect("text");
        assert_eq!(self.program.wait().expect("the program ends").code(), Some(0));
        rest
    }
}

impl Drop for Page {
    fn drop(&mut self) {
        let _ = self.program.kill();
        let _ = self.program.wait();
    }
}

fn train_run(scene: &Photographs, run: &Path) {
    train(scene.path(), run, 40, "--budget 320 --eval --quiet").ok();
}

/// A request for a view of a split with a maximum size.
pub(super) fn frame_request(kind: &str, split: &str, number: usize, size: (u32, u32)) -> Value {
    let view = json!({ "split": split, "number": number });
    json!({ "page": "test", "kind": kind, "width": size.0, "height": size.1, "view": view })
}

/// PSNR of two images of equal size [dB].
fn psnr(a: &RgbImage, b: &RgbImage) -> f64 {
    assert_eq!(a.dimensions(), b.dimensions());
    let squares = a.iter().zip(b.iter()).map(|(a, b)| f64::from(a.abs_diff(*b)).powi(2));
    let mean = squares.sum::<f64>() / a.len() as f64;
    10.0 * (255.0 * 255.0 / mean.max(1e-9)).log10()
}

#[test]
fn frames_match_the_images_of_render() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train_run(&scene, &run);
    let pictures = root.path().join("pictures");
    call(&format!("render {} -o {} --backend cpu", text(&run), text(&pictures))).ok();
    let page = Page::open(text(&run));
    let described: Value = serde_json::from_slice(&page.get("/scene").body).expect("JSON");
    assert_eq!(described["views"]["test"][1]["name"], "view_08.png");
    let first = page.frame(&frame_request("render", "test", 0, SIZE)).picture();
    for (number, name) in [(0, "view_00"), (1, "view_08")] {
        let found = page.frame(&frame_request("render", "test", number, SIZE));
        let written = image::open(pictures.join(format!("{name}.png"))).expect("a PNG").into_rgb8();
        let similarity = psnr(&found.picture(), &written);
        assert!(similarity >= 38.0, "{name}: {similarity} dB");
        // The photograph matches its file.
        let file = image::open(scene.file(&format!("images/{name}.png"))).expect("a PNG");
        let shown =
            page.frame(&frame_request("photograph", "test", number, (4000, 1000))).picture();
        let similarity = psnr(&shown, &file.into_rgb8());
        assert!(similarity >= 38.0, "{name}: the photograph is {similarity} dB from its file");
        // A free camera with the same pose shows the same picture, because the principal points are central.
        let at = &described["views"]["test"][number];
        let camera = json!({ "camera_to_world": at["camera_to_world"], "fov": at["fov"] });
        let free = json!({ "page": "test", "kind": "render", "width": SIZE.0, "height": SIZE.1, "camera": camera });
        let similarity = psnr(&page.frame(&free).picture(), &written);
        assert!(similarity >= 36.0, "{name}: {similarity} dB by its pose");
    }
    let sizes = [((24, 99), (24, 20)), ((96, 80), (96, 80))];
    for (wanted, size) in sizes {
        assert_eq!(
            page.frame(&frame_request("render", "train", 0, wanted)).picture().dimensions(),
            size
        );
    }
    let all = described["kinds"].as_array().expect("kinds").iter();
    let kinds: Vec<&str> = all.filter_map(|kind| kind["kind"].as_str()).collect();
    // No file records the age of Gaussians, so that kind is listed as missing. Edits come from the checkpoint.
    let lacking = described["lacking"].as_array().expect("a list of missing kinds");
    assert_eq!((kinds.len(), lacking.len()), (14, 1), "{described}");
    assert_eq!(page.frame(&frame_request("row_age", "test", 0, SIZE)).status, 400);
    let mut seen: Vec<Vec<u8>> = Vec::new();
    for kind in kinds {
        let reply = page.frame(&frame_request(kind, "test", 0, SIZE));
        assert_eq!(reply.picture().dimensions(), SIZE, "{kind}");
        let has_range = !matches!(kind, "render" | "photograph" | "opacity" | "rows");
        assert_eq!(reply.header("X-Range").is_some(), has_range, "{kind}");
        if kind == "row_edit" {
            assert_eq!(reply.header("X-Range"), Some("0 40"), "the range of edits in 40 steps");
        }
        assert!(!seen.contains(&reply.body), "{kind} equals another kind");
        seen.push(reply.body);
    }
    // The mean difference is the FLIP score of this view.
    let difference = page.frame(&frame_request("difference", "test", 0, SIZE));
    let mean = difference.header("X-Mean").expect("a mean");
    let flip = json(&run.join("per_view.json"))["ours_40"]["FLIP"]["view_00.png"].clone();
    let apart = (mean.parse::<f64>().expect("a number") - flip.as_f64().expect("a number")).abs();
    assert!(apart < 2e-3, "{mean} is not {flip}");
    // Training statistics are measured from the training views, a few per request.
    let measured = |kind: &str| {
        let reply = page.frame(&frame_request(kind, "test", 0, SIZE));
        let (seen, all) =
            reply.header("X-Measured").and_then(|value| value.split_once(' ')).expect("how many");
        (seen == all, all.parse::<usize>().expect("a number"), reply.body)
    };
    let train = described["views"]["train"].as_array().expect("views").len();
    while !measured("row_gradient").0 {}
    let (is_whole, all, gradient) = measured("row_gradient");
    assert_eq!((is_whole, all), (true, train));
    assert!(gradient == measured("row_gradient").2, "measuring did not stop");
    let (is_whole, _, weight) = measured("row_weight");
    assert!(is_whole && weight != gradient);
    let (is_whole, _, in_front) = measured("row_in_front");
    assert!(is_whole && in_front != weight && in_front != gradient);
    // Measuring has not changed the model.
    assert!(psnr(&page.frame(&frame_request("render", "test", 0, SIZE)).picture(), &first) > 99.0);
    #[cfg(unix)]
    assert_eq!(page.end().trim(), "Ctrl-C ends it");
}

#[test]
fn foreign_and_malformed_requests_are_refused_without_effect() {
    let scene = Photographs::colmap_text();
    let (_root, run) = scratch();
    train_run(&scene, &run);
    let page = Page::open(text(&run));
    let sound = frame_request("render", "test", 0, SIZE);
    let first = page.frame(&sound).picture();
    let place = &page.place;
    let refused = |reply: &Reply, status: u16, word: &str| {
        assert_eq!(reply.status, status, "{reply:?}");
        assert!(reply.text().contains(word) && reply.body.len() < 400, "{}", reply.text());
    };
    let mut large = sound.clone();
    large["width"] = 100_000.into();
    refused(&page.frame(&large), 400, "100000x");
    refused(&page.post("Origin: http://evil.example\r\n", &sound.to_string()), 403, "another page");
    refused(&page.post("Origin: null\r\n", &sound.to_string()), 403, "another page");
    assert_eq!(page.post(&format!("Origin: http://{place}\r\n"), &sound.to_string()).status, 200);
    refused(&page.post("", &" ".repeat(5000)), 413, "too long");
    refused(&page.post("", "{}"), 400, "page");
    let evil = "GET / HTTP/1.1\r\nHost: evil.example\r\nConnection: close\r\n\r\n";
    refused(&page.send(evil.as_bytes()), 403, "its own machine");
    let config = text(&run.join("config.toml")).to_owned();
    for path in [&*config, "/../config.toml", "/%2e%2e/%2e%2e/etc/passwd", "/config.toml", "//"] {
        refused(&page.get(path), 404, "nothing here");
    }
    refused(
        &page.send(b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n\r\n"),
        400,
        "not an HTTP",
    );
    refused(&page.send(format!("GET /{} HTTP/1.1\r\n", "a".repeat(9000)).as_bytes()), 431, "long");
    // Idle and incomplete connections do not block others.
    let mut idle: Vec<TcpStream> = (0..1000).map(|_| page.connect()).collect();
    for stream in idle.iter_mut().step_by(3) {
        let _ = stream.write_all(b"POST /frame HTTP/1.1\r\nHost: local");
    }
    assert!(page.frame(&sound).picture() == first, "the frame has changed");
    let page_text = page.get("/").text();
    assert!(page_text.contains("<title>densify view</title>"), "{page_text}");
    #[cfg(unix)]
    page.end();
}

#[test]
fn on_a_network_the_page_needs_its_secret_path() {
    let page = Page::open("tests/fuzz/corpus/ply/twelve.ply --host 0.0.0.0");
    let secret = page.path.trim_matches('/').to_owned();
    assert_eq!(secret.len(), 32, "{}", page.path);
    assert_eq!(page.get("/").status, 404);
    assert_eq!(page.get("/scene").status, 404);
    assert_eq!(page.get(&format!("/{}/scene", "0".repeat(32))).status, 404);
    let described: Value =
        serde_json::from_slice(&page.get(&format!("/{secret}/scene")).body).expect("JSON");
    // Without cameras, the initial camera comes from the bounds, and kinds that need a photograph are missing.
    assert!(described["start"]["fov"].is_number(), "{described}");
    let kinds = described["kinds"].as_array().expect("kinds");
    assert!(kinds.iter().all(|kind| kind["needs_photograph"] == false), "{described}");
    let start = &described["start"];
    let camera = json!({ "camera_to_world": start["camera_to_world"], "fov": start["fov"] });
    let free =
        json!({ "page": "a", "kind": "render", "width": 64, "height": 48, "camera": camera });
    let picture = page.frame(&free).picture();
    let (least, most) = picture.iter().fold((255, 0), |(a, b), &v| (a.min(v), b.max(v)));
    assert!(most - least > 20, "the frame does not show the model");
    assert_eq!(page.frame(&frame_request("render", "test", 0, (9, 9))).status, 400);
}

#[test]
fn scenes_show_their_points_and_two_runs_can_be_compared() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    let page = Page::open(&format!("{} --eval", text(scene.path())));
    let described: Value = serde_json::from_slice(&page.get("/scene").body).expect("JSON");
    assert!(described["models"][0]["name"].as_str().expect("a name").ends_with("its points"));
    let points = described["points"]["positions"].as_array().map_or(0, Vec::len);
    assert!(points > 100, "{points}");
    page.frame(&frame_request("render", "test", 0, SIZE)).picture();
    train_run(&scene, &run);
    // Runs in folders of the same name get distinct names.
    let other = root.path().join("above/run");
    train(scene.path(), &other, 4, "--budget 320 --eval --quiet").ok();
    let page = Page::open(&format!("{} {}", text(&run), text(&other)));
    let described: Value = serde_json::from_slice(&page.get("/scene").body).expect("JSON");
    let name = |model: usize| described["models"][model]["name"].as_str().expect("a name");
    assert!(name(1).starts_with("above/run") && name(0).contains("/run"), "{described}");
    let frame = |model: u32| {
        let mut request = frame_request("render", "test", 0, SIZE);
        request["model"] = model.into();
        page.frame(&request)
    };
    assert!(psnr(&frame(0).picture(), &frame(1).picture()) < 35.0, "both models look the same");
    assert_eq!(frame(2).status, 400);
    assert!(!page.before.contains("note"), "{}", page.before);
    // A different scene or split is reported.
    let elsewhere = Photographs::colmap_text();
    for (scene, flags, words) in
        [(&elsewhere, "--eval", "another scene"), (&scene, "", "other views")]
    {
        train(scene.path(), &other, 4, &format!("--budget 320 --overwrite --quiet {flags}")).ok();
        let page = Page::open(&format!("{} {}", text(&run), text(&other)));
        assert!(page.before.contains(words), "{words}: {}", page.before);
    }
}

#[test]
fn invalid_calls_are_refused_with_a_remedy() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train_run(&scene, &run);
    let run_text = text(&run).to_owned();
    let taken = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
    let port = taken.local_addr().expect("an address").port();
    let empty = root.path().join("empty");
    std::fs::create_dir(&empty).expect("a folder");
    let stopped = root.path().join("stopped");
    // A run that was stopped before it saved a model.
    super::copy_unfinished(&run, &stopped, u32::MAX);
    std::fs::remove_dir_all(stopped.join("point_cloud")).expect("the models");
    let model = densify::train::output::model_path(&run, 40);
    let model = text(&model);
    for (words, expected) in [
        (format!("{run_text} --port {port}"), vec!["--port", "another program", "give none"]),
        (format!("{run_text} --port 70000"), vec!["--port"]),
        (format!("{run_text} --host nowhere"), vec!["--host"]),
        (format!("{run_text} --host 192.0.2.1"), vec!["--host 192.0.2.1", "this machine"]),
        (format!("{run_text} --iteration 7"), vec!["--iteration 7", "40"]),
        (format!("{run_text} -r 2"), vec!["a run brings its own"]),
        (format!("{model} --iteration 40"), vec!["--iteration", "run"]),
        (format!("{run_text} {}", text(&empty)), vec!["neither a run", "config.toml", "two runs"]),
        (format!("scene:spheres {run_text}"), vec!["scene:spheres is a scene", "two runs"]),
        (format!("{run_text} scene:spheres"), vec!["scene:spheres is a scene", "two runs"]),
        (
            text(&stopped).to_owned(),
            vec!["stopped", "checkpoint of iteration 40", "train --resume -o"],
        ),
        (text(&empty).to_owned(), vec!["neither a run", "nor a scene"]),
        ("nowhere".to_owned(), vec!["nowhere", "neither a run"]),
        (format!("{} {run_text}", text(scene.path())), vec!["neither a run", "two runs"]),
    ] {
        call(&format!("view {words} --backend cpu")).refused(&words, &expected);
    }
}

/// A run in progress is shown as last saved, or refused if nothing is saved.
#[cfg(unix)]
#[test]
fn a_run_in_progress_is_shown_as_last_saved() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train_run(&scene, &run);
    // The lock that a training process holds.
    let lock = std::fs::File::create(run.join("densify.lock")).expect("a file");
    lock.lock().expect("a lock");
    let page = Page::open(text(&run));
    assert!(
        page.before.contains("is being trained") && page.before.contains("iteration 40"),
        "{}",
        page.before
    );
    page.frame(&frame_request("render", "test", 0, SIZE)).picture();
    page.end();
    let unsaved = root.path().join("unsaved");
    super::copy_unfinished(&run, &unsaved, 40);
    let lock = std::fs::File::create(unsaved.join("densify.lock")).expect("a file");
    lock.lock().expect("a lock");
    let refused = call(&format!("view {} --backend cpu", text(&unsaved)));
    refused.refused("nothing is saved", &["is being trained", "--save-iterations"]);
}
