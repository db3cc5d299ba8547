//! Every fault is an error that names the file, the place and a remedy; never a panic.
//! The file is one piece because a table row per fault reads best beside the others.

use std::num::NonZeroU32;

use super::super::*;
use super::write::{Made, image};

/// Loads what `edit` made of a dataset; the message must contain every one of `words`.
fn refused(case: &str, made: &Made, options: &LoadOptions, words: &[&str]) {
    let Err(error) = Dataset::load(made.path(), options) else { panic!("{case}: it loaded") };
    let message = error.to_string();
    for word in words {
        assert!(message.contains(word), "{case}: {word:?} is not in: {message}");
    }
}

type Case = (&'static str, fn(&Made), &'static [&'static str]);

fn check(make: fn() -> Made, cases: &[Case]) {
    for (case, edit, words) in cases {
        let made = make();
        edit(&made);
        refused(case, &made, &LoadOptions::default(), words);
    }
}

const COLMAP_TEXT: &[Case] = {
    const IMAGES: &str = "sparse/0/images.txt";
    const CAMERAS: &str = "sparse/0/cameras.txt";
    const POINTS: &str = "sparse/0/points3D.txt";
    &[
        (
            "no cameras",
            |m| std::fs::remove_file(m.file(CAMERAS)).unwrap(),
            &["cameras.txt", "check that it exists"],
        ),
        ("no points", |m| std::fs::remove_file(m.file(POINTS)).unwrap(), &["points3D.txt"]),
        ("zero images", |m| m.write(IMAGES, "# none\n"), &["images.txt", "no image"]),
        (
            "fisheye",
            |m| m.replace(CAMERAS, "PINHOLE", "OPENCV_FISHEYE"),
            &["OPENCV_FISHEYE", "camera 1", "image_undistorter"],
        ),
        (
            "unknown model",
            |m| m.replace(CAMERAS, "PINHOLE", "MAGIC"),
            &["MAGIC", "image_undistorter"],
        ),
        (
            "too few parameters",
            |m| m.replace(CAMERAS, " 10 6\n", " 10\n"),
            &["cameras.txt", "line 2"],
        ),
        (
            "too many parameters",
            |m| m.replace(CAMERAS, " 10 6\n", " 10 6 1\n"),
            &["cameras.txt", "camera 1", "more parameters"],
        ),
        ("fx = 0", |m| m.replace(CAMERAS, " 15 ", " 0 "), &["cameras.txt", "camera 1", "fx"]),
        ("fy < 0", |m| m.replace(CAMERAS, " 16 ", " -16 "), &["camera 1", "fy"]),
        ("fx NaN", |m| m.replace(CAMERAS, " 15 ", " nan "), &["camera 1", "fx"]),
        ("telescope", |m| m.replace(CAMERAS, " 15 ", " 1e9 "), &["camera 1", "field of view"]),
        (
            "cx infinite",
            |m| m.replace(CAMERAS, " 10 6", " inf 6"),
            &["camera 1", "principal point"],
        ),
        ("width 0", |m| m.replace(CAMERAS, " 20 ", " 0 "), &["camera 1", "0x12"]),
        (
            "fold",
            |m| m.replace(CAMERAS, "PINHOLE 20 12 15 16 10 6", "RADIAL 20 12 15 10 6 -3 0"),
            &["images.txt", "distortion", "image_undistorter"],
        ),
        (
            "pose NaN",
            |m| m.replace(IMAGES, "0.5 0 4", "nan 0 4"),
            &["images.txt", "image b.png", "not finite"],
        ),
        (
            "pose infinite",
            |m| m.replace(IMAGES, "0.5 0 4", "0.5 -inf 4"),
            &["image b.png", "not finite"],
        ),
        (
            "quaternion",
            |m| m.replace(IMAGES, "0.8 0 0.6 0", "0.9 0 0.6 0"),
            &["image b.png", "quaternion"],
        ),
        (
            "unknown camera",
            |m| m.replace(IMAGES, " 1 b.png", " 5 b.png"),
            &["images.txt", "b.png", "camera 5"],
        ),
        (
            "number",
            |m| m.replace(IMAGES, "0.5 0 4", "0.5 zero 4"),
            &["images.txt", "line 4", "zero"],
        ),
        ("short line", |m| m.replace(IMAGES, " 1 b.png", ""), &["images.txt", "line 4"]),
        (
            "no observations line",
            |m| m.replace(IMAGES, "1.5 2.5 -1 3 4 7\n", ""),
            &["images.txt", "triples"],
        ),
        ("twice", |m| m.replace(IMAGES, "b.png", "a.png"), &["images.txt", "a.png", "twice"]),
        (
            "image missing",
            |m| std::fs::remove_file(m.file("images/b.png")).unwrap(),
            &["images.txt", "image b.png", "images/b.png", "--images"],
        ),
        (
            "other size",
            |m| image(&m.file("images/b.png"), (20, 20), 0),
            &["images/b.png", "20x20", "20x12"],
        ),
        ("not an image", |m| m.write("images/b.png", "hello"), &["images/b.png", "decode"]),
        (
            "mask size",
            |m| image(&m.file("masks/b.png.png"), (12, 20), 0),
            &["masks/b.png.png", "12x20", "20x12"],
        ),
        (
            "climbs out",
            |m| m.replace(IMAGES, "b.png", "../b.png"),
            &["images.txt", "../b.png", "`..`"],
        ),
        ("absolute", |m| m.replace(IMAGES, "b.png", "/etc/passwd"), &["images.txt", "absolute"]),
        (
            "bad points",
            |m| {
                for (x, bad) in
                    [("\n3 3 ", "\n3 nan "), ("\n4 4 ", "\n4 -inf "), ("\n5 5 ", "\n5 inf ")]
                {
                    m.replace(POINTS, x, bad);
                }
            },
            &["points3D.txt", "3 of 200"],
        ),
        (
            "point out of reach",
            |m| {
                for (x, bad) in
                    [("\n3 3 ", "\n3 1e300 "), ("\n4 4 ", "\n4 1e300 "), ("\n5 5 ", "\n5 -1e300 ")]
                {
                    m.replace(POINTS, x, bad);
                }
            },
            &["points3D.txt", "3 of 200"],
        ),
        (
            "colour",
            |m| m.replace(POINTS, " 3 20 30", " 300 20 30"),
            &["points3D.txt", "line 5", "300"],
        ),
        ("not UTF-8", |m| m.patch(POINTS, |bytes| bytes[20] = 0xff), &["points3D.txt"]),
    ]
};

#[test]
fn colmap_text() {
    check(Made::colmap_txt, COLMAP_TEXT);
}

const COLMAP_BINARY: &[Case] = {
    const IMAGES: &str = "sparse/0/images.bin";
    const CAMERAS: &str = "sparse/0/cameras.bin";
    const POINTS: &str = "sparse/0/points3D.bin";
    &[
        (
            "model 5",
            |m| m.patch(CAMERAS, |b| b[12] = 5),
            &["cameras.bin", "camera 1", "OPENCV_FISHEYE", "image_undistorter"],
        ),
        ("model 77", |m| m.patch(CAMERAS, |b| b[12] = 77), &["camera 1", "number 77"]),
        ("huge width", |m| m.patch(CAMERAS, |b| b[23] = 1), &["camera 1", "impossible"]),
        ("cameras cut", |m| m.patch(CAMERAS, |b| b.truncate(50)), &["cameras.bin"]),
        ("cameras empty", |m| m.write(CAMERAS, ""), &["cameras.bin", "truncated"]),
        (
            "images cut",
            |m| m.patch(IMAGES, |b| b.truncate(b.len() - 30)),
            &["images.bin", "truncated"],
        ),
        ("count too large", |m| m.patch(IMAGES, |b| b[0] = 4), &["images.bin", "byte"]),
        (
            "count too small",
            |m| m.patch(IMAGES, |b| b[0] = 2),
            &["images.bin", "follow the 2 records"],
        ),
        (
            "count absurd",
            |m| m.patch(IMAGES, |b| b[..8].fill(0xff)),
            &["images.bin", "number of images"],
        ),
        ("points absurd", |m| m.patch(POINTS, |b| b[4] = 1), &["points3D.bin", "number of points"]),
        ("points cut", |m| m.patch(POINTS, |b| b.truncate(b.len() - 1)), &["points3D.bin"]),
        (
            "track absurd",
            |m| m.patch(POINTS, |b| b[51..59].fill(0xff)),
            &["points3D.bin", "truncated"],
        ),
        (
            "observations absurd",
            |m| m.patch(IMAGES, |b| b[78..86].fill(0xff)),
            &["images.bin", "truncated"],
        ),
        (
            "name without end",
            |m| {
                m.patch(IMAGES, |b| {
                    b.truncate(72);
                    b.resize(9000, b'x');
                })
            },
            &["images.bin", "4 KiB"],
        ),
        ("name not UTF-8", |m| m.patch(IMAGES, |b| b[72] = 0xff), &["images.bin", "UTF-8"]),
        (
            "pose NaN",
            |m| m.patch(IMAGES, |b| b[44..52].fill(0xff)),
            &["images.bin", "image a.png", "not finite"],
        ),
        ("zero cameras", |m| m.write(CAMERAS, [0; 8]), &["a.png", "camera 1"]),
        ("zero images", |m| m.write(IMAGES, [0; 8]), &["images.bin", "no image"]),
    ]
};

#[test]
fn colmap_binary() {
    check(Made::colmap_bin, COLMAP_BINARY);
}

/// Whatever single byte is damaged, loading ends with a dataset or an error.
#[test]
fn no_damaged_byte_makes_it_panic() {
    let made = Made::colmap_bin();
    for name in ["sparse/0/cameras.bin", "sparse/0/images.bin", "sparse/0/points3D.bin"] {
        let whole = std::fs::read(made.file(name)).unwrap();
        for at in 0..whole.len().min(200) {
            for value in [0, 0x7f, 0xff] {
                let mut bytes = whole.clone();
                bytes[at] = value;
                made.write(name, &bytes);
                let _ = Dataset::load(made.path(), &LoadOptions::default());
            }
            made.write(name, &whole[..at]);
            assert!(
                Dataset::load(made.path(), &LoadOptions::default()).is_err(),
                "{name} cut at {at}"
            );
        }
        made.write(name, whole);
    }
    assert!(Dataset::load(made.path(), &LoadOptions::default()).is_ok());
}

type JsonCase = (&'static str, fn(&mut serde_json::Value), &'static [&'static str]);

const TRANSFORMS: &[JsonCase] = &[
    (
        "test split",
        |j| j["test_filenames"] = serde_json::json!([1]),
        &["transforms.json", "test_filenames", "list of file names"],
    ),
    ("no frames", |j| j["frames"] = 3.into(), &["transforms.json", "frames"]),
    ("frame no object", |j| j["frames"][1] = 3.into(), &["frames[1]"]),
    ("zero frames", |j| j["frames"] = serde_json::json!([]), &["transforms.json", "no image"]),
    (
        "no path",
        |j| drop(j["frames"][1].as_object_mut().unwrap().remove("file_path")),
        &["frames[1].file_path"],
    ),
    (
        "path no string",
        |j| j["frames"][1]["file_path"] = 7.into(),
        &["frames[1].file_path", "string"],
    ),
    (
        "climbs out",
        |j| j["frames"][1]["file_path"] = "../b.png".into(),
        &["frames[1].file_path", "`..`"],
    ),
    (
        "absolute",
        |j| j["frames"][1]["file_path"] = "/b.png".into(),
        &["frames[1].file_path", "absolute"],
    ),
    (
        "NUL",
        |j| j["frames"][1]["file_path"] = "b\0.png".into(),
        &["frames[1].file_path", "control character"],
    ),
    (
        "long",
        |j| j["frames"][1]["file_path"] = "b".repeat(5000).into(),
        &["frames[1].file_path", "4 KiB"],
    ),
    (
        "mask climbs out",
        |j| j["frames"][1]["mask_path"] = "../m.png".into(),
        &["frames[1].mask_path", "`..`"],
    ),
    (
        "mask missing",
        |j| j["frames"][1]["mask_path"] = "m.png".into(),
        &["frames[1].mask_path", "m.png"],
    ),
    ("points climb out", |j| j["ply_file_path"] = "../p.ply".into(), &["ply_file_path", "`..`"]),
    ("points missing", |j| j["ply_file_path"] = "p.ply".into(), &["ply_file_path", "p.ply"]),
    (
        "no matrix",
        |j| drop(j["frames"][1].as_object_mut().unwrap().remove("transform_matrix")),
        &["frames[1].transform_matrix"],
    ),
    (
        "matrix shape",
        |j| {
            j["frames"][1]["transform_matrix"] =
                serde_json::json!([[1, 0, 0], [0, 1, 0], [0, 0, 1]])
        },
        &["frames[1].transform_matrix"],
    ),
    (
        "matrix null",
        |j| j["frames"][1]["transform_matrix"][0][3] = serde_json::Value::Null,
        &["frames[1].transform_matrix"],
    ),
    (
        "scaled",
        |j| j["frames"][0]["transform_matrix"][0][0] = 2.0.into(),
        &["frames[0].transform_matrix", "a.png", "orthonormal"],
    ),
    (
        "mirrored",
        |j| j["frames"][0]["transform_matrix"][0][0] = (-1.0).into(),
        &["frames[0].transform_matrix", "reflection"],
    ),
    (
        "no focal length",
        |j| drop(j.as_object_mut().unwrap().remove("fl_x")),
        &["fl_x", "camera_angle_x"],
    ),
    ("fl_x = 0", |j| j["fl_x"] = 0.into(), &["intrinsics", "fx"]),
    (
        "angle",
        |j| {
            j.as_object_mut().unwrap().remove("fl_x");
            j["camera_angle_x"] = 4.0.into();
        },
        &["intrinsics", "fx"],
    ),
    ("w", |j| j["w"] = 20.5.into(), &["w", "20.5"]),
    ("w < 0", |j| j["w"] = (-20).into(), &["w", "-20"]),
    (
        "fisheye",
        |j| j["camera_model"] = "OPENCV_FISHEYE".into(),
        &["camera_model", "OPENCV_FISHEYE", "image_undistorter"],
    ),
    ("is_fisheye", |j| j["is_fisheye"] = true.into(), &["is_fisheye", "image_undistorter"]),
    ("k3", |j| j["k3"] = 0.1.into(), &["k3", "image_undistorter"]),
    ("fold", |j| j["k1"] = (-5.0).into(), &["distortion", "a.png", "image_undistorter"]),
    ("k1 no number", |j| j["k1"] = "x".into(), &["k1", "number"]),
];

#[test]
fn transforms() {
    for (case, edit, words) in TRANSFORMS {
        refused(case, &Made::transforms(edit), &LoadOptions::default(), words);
    }
    let broken = Made::transforms(|_| ());
    broken.replace("transforms.json", "15.0", "NaN");
    refused("NaN", &broken, &LoadOptions::default(), &["transforms.json", "line 1"]);
    broken.write("transforms.json", "[".repeat(100_000));
    refused("deep", &broken, &LoadOptions::default(), &["transforms.json", "JSON"]);
    let broken = Made::transforms(|_| ());
    broken.write(
        "points.ply",
        "ply\nformat ascii 1.0\nelement vertex 9\nproperty float x\nend_header\n1",
    );
    refused("points", &broken, &LoadOptions::default(), &["points.ply"]);
    let broken = Made::transforms(|_| ());
    std::fs::remove_dir_all(broken.file("images")).unwrap();
    refused("no image at all", &broken, &LoadOptions::default(), &["transforms.json", "no image"]);
}

#[test]
fn folders_and_splits() {
    let empty = tempfile::tempdir().unwrap();
    let message = Dataset::load(empty.path(), &LoadOptions::default()).unwrap_err().to_string();
    assert!(
        message.contains("sparse/0/cameras.bin") && message.contains("transforms.json"),
        "{message}"
    );
    let message =
        Dataset::load(&empty.path().join("none"), &LoadOptions::default()).unwrap_err().to_string();
    assert!(message.contains("none"), "{message}");

    let made = Made::colmap_txt();
    let every_one = LoadOptions { split: Split::Every(NonZeroU32::MIN), ..LoadOptions::default() };
    refused("every view", &made, &every_one, &["all 3", "--test-every"]);
    let other = LoadOptions { images: Some("nowhere".into()), ..LoadOptions::default() };
    refused("no such folder", &made, &other, &["nowhere"]);
    for name in super::write::NAMES {
        image(&made.file("images_2").join(name), (20, 12), 0);
    }
    let half = LoadOptions { resolution: Some(Resolution::Divisor(2)), ..LoadOptions::default() };
    refused("images_2 is not half", &made, &half, &["images_2", "20x12", "10x6"]);
}

#[cfg(unix)]
#[test]
fn links_out_of_the_dataset() {
    let outside = tempfile::tempdir().unwrap();
    for name in super::write::NAMES {
        image(&outside.path().join(name), super::write::SIZE, 0);
    }
    let made = Made::colmap_txt();
    std::fs::remove_dir_all(made.file("images")).unwrap();
    std::os::unix::fs::symlink(outside.path(), made.file("images")).unwrap();
    refused("linked folder", &made, &LoadOptions::default(), &["symbolic link", "--images"]);
    let named = LoadOptions { images: Some(outside.path().to_owned()), ..LoadOptions::default() };
    assert!(Dataset::load(made.path(), &named).is_ok());
}
