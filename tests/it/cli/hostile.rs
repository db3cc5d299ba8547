//! Damaged, mistaken or malicious input: one message that names the file and the fault, and no partial output.

use std::path::Path;

use super::{Outcome, densify, resume, scratch, text, train};
use crate::photographs::{Photographs, VIEWS, name};

/// Returns the message of a refused call after checking that it is one line without control characters.
fn refusal(outcome: &Outcome) -> &str {
    outcome.refused("", &[]);
    let line = outcome.stderr.strip_suffix('\n').expect("a line");
    assert!(!line.contains(char::is_control), "{line:?}");
    line
}

/// A scene whose photographs are JPEGs.
fn jpegs() -> Photographs {
    let scene = Photographs::colmap_text();
    for view in 0..VIEWS {
        let path = scene.file(&format!("images/{}", name(view)));
        let image = image::open(&path).expect("a photograph");
        image.save(path.with_extension("jpg")).expect("a JPEG");
        scene.replace("sparse/0/images.txt", ".png", ".jpg");
    }
    scene
}

#[test]
fn truncated_jpegs_are_refused() {
    let scene = jpegs();
    let (_root, run) = scratch();
    train(scene.path(), &run, 3, "--budget 300").ok();
    let photograph = "images/view_03.jpg";
    let whole = std::fs::read(scene.file(photograph)).expect("a photograph");
    for percent in [10, 50, 90, 99] {
        scene.write(photograph, &whole[..whole.len() * percent / 100]);
        let (_root, run) = scratch();
        let outcome = train(scene.path(), &run, 20, "--budget 300 --init random");
        let message = refusal(&outcome);
        assert!(message.contains("view_03.jpg"), "{percent} %: {message}");
        assert!(!run.exists(), "{percent} %");
    }
}

#[test]
fn a_distant_camera_is_left_out_and_named() {
    let scene = Photographs::colmap_text();
    let trained = |flags: &str| {
        let (_root, run) = scratch();
        let outcome = train(scene.path(), &run, 60, &format!("--budget 300 --eval {flags}")).ok();
        let scores = super::json(&run.join("results.json"));
        let psnr = scores["ours_60"]["PSNR"].as_f64().expect("a number");
        let per_view = super::json(&run.join("per_view.json"));
        let views = per_view["ours_60"]["PSNR"].as_object().expect("a number for each view");
        assert!(views.keys().eq(["view_00.png", "view_08.png"]), "{views:?}");
        (outcome.stdout, psnr)
    };
    let (stdout, usual) = trained("");
    assert!(!stdout.contains("far"), "{stdout}");
    // The last number of a pose is the distance along the optical axis.
    let images = std::fs::read_to_string(scene.file("sparse/0/images.txt")).expect("a text");
    let line = images.lines().find(|line| line.ends_with("view_05.png")).expect("its line");
    let mut words: Vec<&str> = line.split(' ').collect();
    words[7] = "2000";
    scene.replace("sparse/0/images.txt", line, &words.join(" "));
    let (stdout, psnr) = trained("");
    assert!(
        stdout.contains("cameras far from all others, 1 left out")
            && stdout.contains("view_05.png"),
        "{stdout}"
    );
    assert!((psnr - usual).abs() < 2.0, "{psnr} dB, {usual} dB without the camera");
    let (stdout, psnr) = trained("--far-cameras keep");
    assert!(stdout.contains("view_05.png") && stdout.contains("kept"), "{stdout}");
    assert!((psnr - usual).abs() < 3.0, "{psnr} dB, {usual} dB without the camera");
}

#[test]
fn a_model_that_renders_nothing_is_an_error() {
    let scene = Photographs::colmap_text();
    let points = std::fs::read_to_string(scene.file("sparse/0/points3D.txt")).expect("a text");
    let moved: String = points
        .lines()
        .map(|line| {
            let mut words: Vec<&str> = line.split(' ').collect();
            words[2] = "900";
            words.join(" ") + "\n"
        })
        .collect();
    scene.write("sparse/0/points3D.txt", moved);
    let (_root, run) = scratch();
    let outcome = train(scene.path(), &run, 30, "--budget 300");
    assert_eq!(outcome.code, Some(1), "{outcome:?}");
    assert!(outcome.stderr.contains("draws nothing in 14 of the last 14 views"), "{outcome:?}");
    // Resuming the completed run fails, too.
    let again = resume(scene.path(), &run, "");
    assert!(again.code == Some(1) && again.stderr.contains("draws nothing in 14"), "{again:?}");
}

#[test]
fn control_characters_in_names_are_escaped() {
    let (_root, run) = scratch();
    let colmap = Photographs::colmap_text();
    colmap.replace("sparse/0/images.txt", &name(0), "view\u{1b}[2J\u{7}.png");
    let json = Photographs::transforms();
    json.replace("transforms_train.json", "./train/r_1", "./train/r\\u001b[2J\\n\\u0007");
    for (scene, shown) in [(&colmap, "view\\u{1b}[2J\\u{7}.png"), (&json, "r\\u{1b}[2J\\n\\u{7}")] {
        let outcome = train(scene.path(), &run, 3, "--budget 300");
        let message = refusal(&outcome);
        assert!(message.contains(shown) && message.contains("control character"), "{message}");
    }
}

#[test]
fn files_of_another_kind_are_identified() {
    let scene = Photographs::colmap_text();
    let (_root, run) = scratch();
    let pointer = "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n";
    for file in ["images/view_02.png", "sparse/0/images.txt"] {
        let whole = std::fs::read(scene.file(file)).expect("a file");
        scene.write(file, pointer);
        let outcome = train(scene.path(), &run, 3, "--budget 300");
        let message = refusal(&outcome);
        let name = Path::new(file).file_name().and_then(|name| name.to_str()).expect("a name");
        assert!(message.contains("git lfs pull") && message.contains(name), "{message}");
        scene.write(file, whole);
    }
    let whole = std::fs::read_to_string(scene.file("sparse/0/images.txt")).expect("a file");
    let utf16: Vec<u8> = "\u{feff}1 0\n".encode_utf16().flat_map(u16::to_le_bytes).collect();
    scene.write("sparse/0/images.txt", utf16);
    let outcome = train(scene.path(), &run, 3, "--budget 300");
    assert!(refusal(&outcome).contains("UTF-16"), "{outcome:?}");
    // Some editors write a byte-order mark, which must be ignored.
    scene.write("sparse/0/images.txt", format!("\u{feff}{whole}"));
    train(scene.path(), &run, 3, "--budget 300").ok();
}

#[test]
fn invalid_cameras_and_missing_images_are_located() {
    let scene = Photographs::colmap_text();
    let (_root, run) = scratch();
    scene.replace("sparse/0/cameras.txt", " 24 20", " 240 20");
    let outcome = train(scene.path(), &run, 3, "--budget 300");
    let message = refusal(&outcome);
    assert!(message.contains("the principal point (240, 20) px is far outside"), "{message}");
    let scene = Photographs::transforms();
    let frames = scene.file("train");
    std::fs::rename(&frames, scene.file("elsewhere")).expect("a folder");
    std::fs::rename(scene.file("test"), scene.file("away")).expect("a folder");
    let outcome = train(scene.path(), &run, 3, "--budget 300");
    let message = refusal(&outcome);
    let first = text(&frames).to_owned() + "/r_1";
    assert!(message.contains(&first) && message.contains("--images"), "{message}");
}

/// A ZIP archive of one file.
fn archive(name: &str, contents: &[u8]) -> Vec<u8> {
    let mut writer = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
    writer.start_file(name, zip::write::SimpleFileOptions::default()).expect("a file");
    std::io::Write::write_all(&mut writer, contents).expect("its bytes");
    writer.finish().expect("an archive").into_inner()
}

/// Unusable lenses and malicious archives: a message with the remedy, and nothing is written.
#[test]
fn unusable_lenses_and_archives_are_refused() {
    let with_lens = |lens: &str| {
        let scene = Photographs::colmap_text();
        scene.replace("sparse/0/cameras.txt", "PINHOLE 48 40 52 52 24 20", lens);
        scene
    };
    let with_archive = |name: &str, contents: &[u8]| {
        let scene = Photographs::colmap_text();
        scene.write("scan.zip", archive(name, contents));
        scene
    };
    for (scene, file, words) in [
        (
            with_lens("RADIAL 48 40 52 24 20 -3 0"),
            "",
            &["images.txt", "folds over", "largest usable field", "--keep-fov"][..],
        ),
        (
            with_lens("OPENCV 48 40 52 52 24 20 nan 0 0 0"),
            "",
            &[
                "cameras.txt",
                "camera 1",
                "distortion",
                "not finite",
                "repair the camera's parameters",
            ],
        ),
        (
            with_archive("images/zeros.png", &vec![0; 65 << 20]),
            "scan.zip",
            &["scan.zip", "unpacks to more than 64.0 MiB", "unpack it yourself"],
        ),
        (
            with_archive("../../out.png", b"?"),
            "scan.zip",
            &["scan.zip", "../../out.png", "`..`", "pack the folder again"],
        ),
    ] {
        let (_root, run) = scratch();
        let outcome = train(&scene.file(file), &run, 3, "--budget 300");
        let message = refusal(&outcome);
        for word in words {
            assert!(message.contains(word), "{word:?} is not in: {message}");
        }
        assert!(!run.exists(), "{message}");
    }
}

#[test]
fn the_number_of_posed_images_is_reported() {
    let scene = Photographs::colmap_text();
    let (_root, run) = scratch();
    std::fs::copy(scene.file("images/view_01.png"), scene.file("images/extra.png"))
        .expect("a copy");
    let outcome = train(scene.path(), &run, 3, "--budget 300").ok();
    assert!(outcome.stdout.contains("poses of 14 of 15 images"), "{}", outcome.stdout);
}

#[cfg(unix)]
#[test]
fn pipes_and_devices_are_refused_without_waiting() {
    let scene = Photographs::colmap_text();
    let (_root, run) = scratch();
    let outcome = train(scene.path(), &run, 3, "--config /dev/zero");
    assert!(refusal(&outcome).contains("/dev/zero: it is a pipe"), "{outcome:?}");
    let pipe = scene.file("images/view_02.png");
    std::fs::remove_file(&pipe).expect("a photograph");
    let made = std::process::Command::new("mkfifo").arg(&pipe).status().expect("mkfifo");
    assert!(made.success());
    let outcome = train(scene.path(), &run, 3, "--budget 300");
    assert!(refusal(&outcome).contains("view_02.png"), "{outcome:?}");
    let outcome = densify(&["export", text(&pipe), "-o", text(&run.with_extension("ply"))]);
    assert!(refusal(&outcome).contains("view_02.png"), "{outcome:?}");
}

#[cfg(unix)]
#[test]
fn mesh_pipes_are_refused_without_waiting() {
    let (root, out) = scratch();
    let (gltf, pipe) = (root.path().join("mesh.gltf"), root.path().join("data.bin"));
    let obj = root.path().join("mesh.obj");
    for path in [&pipe, &obj] {
        let made = std::process::Command::new("mkfifo").arg(path).status().expect("mkfifo");
        assert!(made.success());
    }
    let document = serde_json::json!({
        "asset": { "version": "2.0" },
        "scenes": [{ "nodes": [0] }],
        "nodes": [{ "mesh": 0 }],
        "meshes": [{ "primitives": [{ "attributes": { "POSITION": 0 } }] }],
        "accessors": [{ "bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3" }],
        "bufferViews": [{ "buffer": 0, "byteLength": 36 }],
        "buffers": [{ "uri": "data.bin", "byteLength": 36 }],
    });
    let document = document.to_string();
    std::fs::write(&gltf, document).expect("a mesh");
    for (mesh, name) in [(&obj, "mesh.obj"), (&gltf, "data.bin")] {
        let outcome = densify(&["scenegen", text(mesh), "-o", text(&out)]);
        let message = refusal(&outcome);
        assert!(message.contains(name) && message.contains("a pipe"), "{message}");
    }
}
