//! `densify render --path`: camera paths rendered as frames and videos.

use std::ffi::OsString;
use std::path::Path;

use image::AnimationDecoder;
use image::codecs::webp::WebPDecoder;

use super::inspecting::{ITERATIONS, size, train_run};
use super::{Outcome, WITHOUT_GPU, call, files, json, outcome_of, scratch, text};
use crate::photographs::Photographs;

#[test]
fn a_camera_path_is_rendered_as_frames_and_video() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train_run(&scene, &run);
    let frames = root.path().join("frames");
    let video = root.path().join("films/orbit.webp");
    let call_with =
        |more: &str| call(&format!("render {} -o {} {more}", text(&run), text(&frames)));
    let options = "--path orbit --frames 5 --size 31x20 --depth --fps 8";
    call_with(&format!("{options} --video {}", text(&video))).ok();
    let names: Vec<String> = files(&frames).into_keys().collect();
    let expected =
        (0..5).flat_map(|n| ["depth.npy", "depth.png", "png"].map(|e| format!("frame_{n:05}.{e}")));
    let expected: Vec<String> = ["depth.json".to_owned()].into_iter().chain(expected).collect();
    assert_eq!(names, expected);
    assert_eq!(size(&frames, "frame_00004.png"), (31, 20));
    let still = |n: u32| image::open(frames.join(format!("frame_{n:05}.png"))).expect("a picture");
    assert!(still(0) != still(1), "the camera does not move");
    let bytes = std::fs::read(&video).expect("a video");
    let decoder = WebPDecoder::new(std::io::Cursor::new(bytes)).expect("it is WebP");
    let video = decoder.into_frames().collect_frames().expect("an animation");
    assert_eq!(video.len(), 5);
    for (frame, n) in video.iter().zip(0..) {
        assert_eq!(frame.delay().numer_denom_ms(), (125, 1));
        let pixels = image::DynamicImage::from(frame.buffer().clone()).into_rgb8();
        assert!(pixels == still(n).into_rgb8(), "video frame {n} differs from its PNG");
    }
    // Invalid options are refused before any frame is rendered.
    for (more, words) in [
        ("--video a.avi --path spiral", [".mp4", ".webp"]),
        ("--path nowhere.json", ["--path", "nowhere.json"]),
        ("--path orbit --side-by-side", ["--side-by-side", "camera path"]),
        ("--path orbit --size 0x5", ["--size", "640x480"]),
        ("--path orbit --frames 0", ["--frames", "1..="]),
    ] {
        let other = root.path().join("other");
        let refused = call(&format!("render {} -o {} {more}", text(&run), text(&other)));
        refused.refused(more, &words);
        assert!(!other.exists(), "{more}");
    }
}

#[test]
fn a_camera_path_in_a_file_is_in_the_datasets_coordinates() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train_run(&scene, &run);
    // The first training camera of the run, in nerfstudio's format.
    let cameras = json(&run.join("cameras.json"));
    let first = &cameras[0];
    let number = |value: &serde_json::Value| value.as_f64().expect("a number");
    let row = |i: usize| -> [f64; 4] {
        let rotation = &first["rotation"][i];
        // Columns are x right, y down, z forward; nerfstudio's y and z point the other way.
        [
            number(&rotation[0]),
            -number(&rotation[1]),
            -number(&rotation[2]),
            number(&first["position"][i]),
        ]
    };
    let pose = [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]].concat();
    let height = number(&first["height"]);
    let fov = 2.0 * (0.5 * height / number(&first["fy"])).atan().to_degrees();
    let path = root.path().join("path.json");
    let key = serde_json::json!({ "camera_to_world": pose, "fov": fov, "aspect": 1.2 });
    std::fs::write(&path, serde_json::json!({ "camera_path": [key] }).to_string()).unwrap();
    let frames = root.path().join("frames");
    let run_text = text(&run);
    call(&format!("render {run_text} -o {} --path {}", text(&frames), text(&path))).ok();
    let views = root.path().join("views");
    call(&format!("render {run_text} -o {} --split train", text(&views))).ok();
    call(&format!("render {run_text} -o {}", text(&views))).ok();
    let name = first["img_name"].as_str().expect("a name");
    let stem = name.rsplit_once('.').map_or(name, |(stem, _)| stem);
    let open = |path: &Path| image::open(path).expect("a picture").into_rgb8();
    let frame = open(&frames.join("frame_00000.png"));
    let view = open(&views.join(format!("{stem}.png")));
    assert_eq!(files(&frames).len(), 1, "one frame for each camera");
    assert_eq!(frame.dimensions(), view.dimensions());
    let most = frame.iter().zip(view.iter()).map(|(a, b)| a.abs_diff(*b)).max();
    assert!(most.is_some_and(|most| most <= 2), "{most:?}");
    // A bare model needs no dataset for a camera path.
    let (model, alone) =
        (densify::train::output::model_path(&run, ITERATIONS), root.path().join("alone"));
    let words = format!("render {} -o {} --path {}", text(&model), text(&alone), text(&path));
    call(&words).refused("no size", &["--path", "--size"]);
    call(&format!("{words} --size {}x{}", view.width(), view.height())).ok();
    let frame = open(&alone.join("frame_00000.png"));
    let most = frame.iter().zip(view.iter()).map(|(a, b)| a.abs_diff(*b)).max();
    assert!(most.is_some_and(|most| most <= 4), "{most:?}");
    // Duration and size come from the file.
    let lasting = serde_json::json!({ "camera_path": [key], "seconds": 0.5, "fps": 8, "render_width": 18,
        "render_height": 10, "crop": { "crop_center": [0, 0, 0], "crop_scale": [1, 1, 1] } });
    std::fs::write(&path, lasting.to_string()).unwrap();
    let video = root.path().join("film.webp");
    let lasting = call(&format!(
        "render {run_text} -o {} --path {} --video {}",
        text(&root.path().join("lasting")),
        text(&path),
        text(&video)
    ));
    assert!(lasting.ok().stdout.contains("path.json: its crop is ignored"));
    assert_eq!(size(&root.path().join("lasting"), "frame_00003.png"), (18, 10));
    let bytes = std::fs::read(&video).expect("a video");
    let decoder = WebPDecoder::new(std::io::Cursor::new(bytes)).expect("it is WebP");
    let video = decoder.into_frames().collect_frames().expect("an animation");
    assert_eq!((video.len(), video[0].delay().numer_denom_ms()), (4, (125, 1)));
}

/// A stand-in for ffmpeg records its arguments and writes the video; another one fails.
#[cfg(unix)]
#[test]
fn ffmpeg_gets_only_the_frames_of_this_call() {
    use std::os::unix::fs::PermissionsExt;

    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train_run(&scene, &run);
    let bin = root.path().join("bin");
    std::fs::create_dir(&bin).unwrap();
    // A % in the path must not become part of ffmpeg's pattern.
    let frames = root.path().join("100%d frames");
    let video = root.path().join("films/a film.mp4");
    let render = |more: &[&str]| -> Outcome {
        let mut command = assert_cmd::Command::new(env!("CARGO_BIN_EXE_densify"));
        command.args(["render", text(&run), "-o", text(&frames), "--path", "orbit"]).args(more);
        let path = std::env::var_os("PATH").unwrap_or_default();
        let path = [bin.as_os_str(), &path].join(&OsString::from(":"));
        command.args(["--size", "8x6"]).envs([WITHOUT_GPU]).env("PATH", path);
        outcome_of(command)
    };
    let install_ffmpeg = |script: &str| {
        let program = bin.join("ffmpeg");
        std::fs::write(&program, format!("#!/bin/sh\n{script}\n")).unwrap();
        std::fs::set_permissions(&program, PermissionsExt::from_mode(0o755)).unwrap();
    };
    install_ffmpeg("exit 127");
    let alone = ["--frames", "9", "--video", text(&video)];
    render(&alone).refused("no ffmpeg", &["--video", "a film.mp4", "install it", ".webp"]);
    assert!(!frames.exists() && !video.exists());

    render(&["--frames", "9"]).ok();
    let log = root.path().join("log");
    install_ffmpeg(&format!(
        "[ \"$1\" = -version ] && exit 0; pwd > '{0}'; printf '%s\\n' \"$@\" >> '{0}'\n\
         for last; do :; done; printf film > \"$last\"",
        log.display()
    ));
    render(&["--frames", "3", "--video", text(&video), "--fps", "12"]).ok();
    assert_eq!(files(&frames).len(), 9, "frames of an earlier, longer call are kept");
    let arguments = std::fs::read_to_string(&log).expect("recorded arguments");
    let arguments: Vec<&str> = arguments.lines().collect();
    assert_eq!(Path::new(arguments[0]), frames.canonicalize().unwrap());
    for pair in
        [["-framerate", "12"], ["-frames:v", "3"], ["-start_number", "0"], ["-i", "frame_%05d.png"]]
    {
        assert!(arguments.windows(2).any(|words| words == pair), "{pair:?}: {arguments:?}");
    }
    assert_eq!(std::fs::read(&video).expect("a video"), b"film");
    // The video has the permissions of any new file.
    let mode = |path: &Path| std::fs::metadata(path).unwrap().permissions().mode() & 0o777;
    std::fs::write(root.path().join("new"), "").unwrap();
    assert_eq!(mode(&video), mode(&root.path().join("new")));

    install_ffmpeg(
        "[ \"$1\" = -version ] && exit 0; echo 'no room' >&2; echo 'frame 7: bad' >&2; exit 3",
    );
    let failed = render(&alone);
    assert_eq!(failed.code, Some(1), "{failed:?}");
    assert!(
        failed.stderr.contains("frame 7: bad") && failed.stderr.contains("100%d frames"),
        "{failed:?}"
    );
    assert_eq!(std::fs::read(&video).expect("the previous video"), b"film");
}
