//! Tests of broken datasets: every fault is an error that names the file, the place and a remedy.

use std::num::NonZeroU32;

use serde_json::Value;

use super::super::*;
use super::{edits_are_refused, refused};
use densify_fixtures::{Made, image};

/// A text, its replacement, and words of the message.
type Replacement = (&'static str, &'static str, &'static str);

const CAMERAS: &[Replacement] = &[
    ("PINHOLE", "RAD_TAN_THIN_PRISM_FISHEYE", "PRISM_FISHEYE, camera 1, image_undistorter"),
    ("PINHOLE 20 12 15 16 10 6", "FOV 20 12 15 16 10 6 nan", "camera 1, distortion, not finite"),
    ("PINHOLE 20 12 15 16 10 6", "FOV 20 12 15 16 10 6 3.1", "camera 1, omega"),
    (
        "PINHOLE 20 12 15 16 10 6",
        "OPENCV_FISHEYE 20 12 1 1 10 6 0 0 0 0",
        "camera 1, field of view",
    ),
    ("PINHOLE", "MAGIC", "MAGIC, image_undistorter"),
    ("PINHOLE 20 12 15 16 10 6", "EQUIRECTANGULAR 20 10 20 10", "EQUIRECTANGULAR, faces of a cube"),
    ("PINHOLE 20 12 15 16 10 6", "SPHERICAL 20 10 20 10", "model SPHERICAL is, faces of a cube"),
    ("PINHOLE 20 12 15 16 10 6", "EUCM 20 12 15 16 10 6 0 1", "EUCM, image_undistorter"),
    (" 10 6\n", " 10\n", "cameras.txt, line 2: camera 1: PINHOLE has 4 parameters, not 3"),
    (" 10 6\n", " 10 6 1\n", "cameras.txt, camera 1: PINHOLE has 4 parameters, not 5"),
    (" 15 ", " 0 ", "cameras.txt, camera 1, fx"),
    (" 16 ", " -16 ", "camera 1, fy"),
    (" 15 ", " nan ", "camera 1, fx"),
    (" 15 ", " 1e9 ", "camera 1, field of view"),
    (" 10 6", " inf 6", "camera 1, principal point"),
    (" 20 ", " 0 ", "camera 1, 0x12"),
    // A distortion that folds over.
    (
        "PINHOLE 20 12 15 16 10 6",
        "RADIAL 20 12 15 10 6 -3 0",
        "images.txt, folds over, largest usable field, KeepFieldOfView",
    ),
];

const IMAGES: &[Replacement] = &[
    ("0.5 0 4", "nan 0 4", "images.txt, image b.png, not finite"),
    ("0.5 0 4", "0.5 -inf 4", "image b.png, not finite"),
    ("0.5 0 4", "0.5 zero 4", "images.txt, line 4, zero"),
    ("0.8 0 0.6 0", "0.9 0 0.6 0", "image b.png, quaternion"),
    (" 1 b.png", " 5 b.png", "images.txt, b.png, camera 5"),
    (" 1 b.png", "", "images.txt, line 4"),
    ("1.5 2.5 -1 3 4 7", "1.5 2.5 -1 3 4", "images.txt, triples"),
    ("1.5 2.5 -1 3 4 7", "1.5 2.5 x", "images.txt, line 3, image id, 1.5"),
    ("b.png", "a.png", "images.txt, a.png, twice"),
    ("b.png", "../b.png", "images.txt, ../b.png, `..`"),
    ("b.png", "/etc/passwd", "images.txt, absolute"),
];

const POINTS: &[Replacement] = &[(" 3 20 30", " 300 20 30", "points3D.txt, line 5, 300")];

#[test]
fn options_for_masks_need_masks() {
    let inverts = LoadOptions { invert_masks: true, ..LoadOptions::default() };
    let background = LoadOptions { mask_mode: MaskMode::Background, ..LoadOptions::default() };
    for (options, words) in [(inverts, "inverted: true"), (background, "inverted: false")] {
        let words = format!("images.txt, no photograph has a mask, {words}");
        refused("no mask", &Made::colmap_txt(), &options, &words);
    }
}

#[test]
fn faults_of_colmap_text_files_are_named() {
    for (file, cases) in
        [("cameras.txt", CAMERAS), ("images.txt", IMAGES), ("points3D.txt", POINTS)]
    {
        for (old, new, words) in cases {
            let made = Made::colmap_txt();
            made.replace(&format!("sparse/0/{file}"), old, new);
            refused(&format!("{file}: {new}"), &made, &LoadOptions::default(), words);
        }
    }
    edits_are_refused(
        Made::colmap_txt,
        &[
            (
                "no cameras",
                |m| m.remove("sparse/0/cameras.txt"),
                "cameras.txt, check that it exists",
            ),
            ("zero images", |m| m.write("sparse/0/images.txt", "# none\n"), "images.txt, no image"),
            (
                "no image",
                |m| m.remove("images/b.png"),
                "images.txt, image b.png, images/b.png does not exist\", RestoreOrImagesFolder",
            ),
            (
                "another extension",
                |m| std::fs::rename(m.file("images/b.png"), m.file("images/b.jpg")).unwrap(),
                "images.txt, image b.png, images/b.png does not exist, but b.jpg does",
            ),
            (
                "other size",
                |m| image(&m.file("images/b.png"), (20, 20), 0),
                "images/b.png, 20x20, 20x12",
            ),
            ("not an image", |m| m.write("images/b.png", "hello"), "images/b.png, decode"),
            (
                "mask",
                |m| image(&m.file("masks/b.png.png"), (12, 20), 0),
                "masks/b.png.png, 12x20, 20x12",
            ),
            ("bad points", |m| three_points(m, ["nan", "-inf", "inf"]), "points3D.txt, 3 of 200"),
            (
                "far points",
                |m| three_points(m, ["1e300", "1e300", "-1e300"]),
                "points3D.txt, 3 of 200",
            ),
            ("not UTF-8", |m| m.patch("sparse/0/points3D.txt", |b| b[20] = 0xff), "points3D.txt"),
            (
                "a name that is not UTF-8",
                |m| {
                    m.patch("sparse/0/images.txt", |b| {
                        *b.iter_mut().rfind(|b| **b == b'p').unwrap() = 0xff
                    })
                },
                "images.txt, UTF-8, rename the image",
            ),
        ],
    );
}

/// Replaces the x coordinates of three of the 200 points.
fn three_points(made: &Made, x: [&str; 3]) {
    for (point, x) in (3..6).zip(x) {
        let (old, new) = (format!("\n{point} {point} "), format!("\n{point} {x} "));
        made.replace("sparse/0/points3D.txt", &old, &new);
    }
}

/// A file, a change of its bytes, and words of the message.
type Patch = (&'static str, fn(&mut Vec<u8>), &'static str);

const COLMAP_BINARY: &[Patch] = &[
    ("cameras", |b| b[12] = 11, "cameras.bin, camera 1, PRISM_FISHEYE, image_undistorter"),
    ("cameras", |b| b[12] = 12, "camera 1, model SIMPLE_DIVISION is, image_undistorter"),
    ("cameras", |b| b[12] = 13, "camera 1, model DIVISION is, image_undistorter"),
    ("cameras", |b| b[12] = 14, "camera 1, model SIMPLE_FISHEYE is, image_undistorter"),
    ("cameras", |b| b[12] = 15, "camera 1, model FISHEYE is, image_undistorter"),
    ("cameras", |b| b[12] = 16, "camera 1, model EUCM is, image_undistorter"),
    ("cameras", panorama, "camera 1, model EQUIRECTANGULAR is, faces of a cube"),
    ("cameras", |b| b[12] = 18, "camera 1, number 18, image_undistorter"),
    ("cameras", |b| b[23] = 1, "camera 1, impossible"),
    ("cameras", |b| b.truncate(50), "cameras.bin"),
    ("cameras", Vec::clear, "cameras.bin, truncated"),
    ("cameras", |b| *b = vec![0; 8], "a.png, camera 1"),
    ("images", |b| *b = vec![0; 8], "images.bin, no image"),
    ("images", |b| b.truncate(b.len() - 30), "images.bin, truncated"),
    ("images", |b| b[0] = 4, "images.bin, byte"),
    ("images", |b| b[0] = 2, "images.bin, follow the 2 records"),
    ("images", |b| b[..8].fill(0xff), "images.bin, number of images"),
    ("images", |b| b[78..86].fill(0xff), "images.bin, truncated"),
    ("images", |b| *b = [&b[..72], &[b'x'; 9000]].concat(), "images.bin, 4 KiB"),
    ("images", |b| b[72] = 0xff, "images.bin, UTF-8, rename the image"),
    ("images", |b| b[44..52].fill(0xff), "images.bin, image a.png, not finite"),
    ("points3D", |b| b[4] = 1, "points3D.bin, number of points"),
    ("points3D", |b| b.truncate(b.len() - 1), "points3D.bin"),
    ("points3D", |b| b[51..59].fill(0xff), "points3D.bin, truncated"),
];

/// Makes the camera a panorama, whose two parameters repeat the image size, as COLMAP writes them.
fn panorama(cameras: &mut Vec<u8>) {
    cameras[12] = 17;
    cameras.truncate(8 + 24 + 16);
}

#[test]
fn faults_of_colmap_binary_files_are_named() {
    for (number, (file, edit, words)) in COLMAP_BINARY.iter().enumerate() {
        let made = Made::colmap_bin();
        made.patch(&format!("sparse/0/{file}.bin"), edit);
        refused(&format!("case {number}, {file}"), &made, &LoadOptions::default(), words);
    }
}

/// Whichever of the first 200 bytes of a file is damaged, loading returns a dataset or an error.
#[test]
fn no_damaged_byte_causes_a_panic() {
    let made = Made::colmap_bin();
    let load = || Dataset::load(made.path(), &LoadOptions::default());
    for name in ["sparse/0/cameras.bin", "sparse/0/images.bin", "sparse/0/points3D.bin"] {
        let whole = std::fs::read(made.file(name)).unwrap();
        for at in 0..whole.len().min(200) {
            for value in [0, 0x7f, 0xff] {
                let mut bytes = whole.clone();
                bytes[at] = value;
                made.write(name, &bytes);
                let _ = load();
            }
            made.write(name, &whole[..at]);
            assert!(load().is_err(), "{name} cut at {at}");
        }
        made.write(name, whole);
    }
    assert!(load().is_ok());
}

/// Pointer to a field of transforms.json, its replacement (empty: the field is removed), and words of the message.
const TRANSFORMS: &[Replacement] = &[
    ("/test_filenames", "[1]", "transforms.json, test_filenames, list of file names"),
    ("/train_filenames", "3", "transforms.json, train_filenames, list of file names"),
    (
        "/train_filenames",
        "[\"images/a.png\", \"images/z.png\", \"images/y.png\"]",
        "transforms.json, train_filenames, no frame has, images/y.png, and 1 more",
    ),
    ("/val_filenames", "[\"a.png\"]", "transforms.json, val_filenames, no frame has, a.png"),
    ("/test_filenames", "[\"../a.png\"]", "transforms.json, test_filenames, `..`"),
    ("/train_filenames", "[]", "transforms.json, train_filenames, no frame to train on"),
    (
        "/test_filenames",
        "[\"images/a.png\", \"images/b.png\", \"images/c.png\"]",
        "transforms.json, test_filenames, no frame to train on",
    ),
    ("/frames", "3", "transforms.json, frames"),
    ("/frames", "[]", "transforms.json, no image"),
    ("/frames/1", "3", "frames[1]"),
    ("/test_frames", "3", "transforms.json, test_frames, list of frames"),
    ("/test_frames", "[{}]", "transforms.json, test_frames[0].file_path, missing"),
    ("/frames/1/is_bad", "\"no\"", "frames[1].is_bad, neither true nor false"),
    ("/frames/1/file_path", "", "frames[1].file_path"),
    ("/frames/1/file_path", "7", "frames[1].file_path, string"),
    ("/frames/1/file_path", "\"../b.png\"", "frames[1].file_path, `..`"),
    ("/frames/1/file_path", "\"/b.png\"", "frames[1].file_path, absolute"),
    ("/frames/1/file_path", "\"b\\u0000.png\"", "frames[1].file_path, control character"),
    ("/frames/1/file_path", "\"b\\u001b[2J\\n\"", "frames[1].file_path, control character"),
    ("/frames/1/file_path", "\"./\"", "frames[1].file_path, is empty"),
    ("/frames/1/file_path", "\"a\\\\..\\\\b\"", "frames[1].file_path, `..`"),
    ("/frames/1/file_path", "\"C:\\\\a\"", "frames[1].file_path, absolute"),
    ("/frames/1/file_path", "\"\\\\\\\\host\"", "frames[1].file_path, absolute"),
    ("/frames/1/file_path", "\"file:///a\"", "frames[1].file_path, absolute"),
    ("/frames/1/mask_path", "\"../m.png\"", "frames[1].mask_path, `..`"),
    ("/frames/1/mask_path", "\"m.png\"", "frames[1].mask_path, m.png"),
    ("/frames/1/transform_matrix", "", "frames[1].transform_matrix"),
    ("/frames/1/transform_matrix", "[[1, 0, 0], [0, 1, 0], [0, 0, 1]]", "transform_matrix"),
    ("/frames/1/transform_matrix/0/3", "null", "frames[1].transform_matrix"),
    ("/frames/0/transform_matrix/0/0", "2.0", "frames[0].transform_matrix, a.png, orthonormal"),
    ("/frames/0/transform_matrix/0/0", "-1.0", "frames[0].transform_matrix, reflection"),
    (
        "/frames/1/transform_matrix",
        "[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [2, 3, 4, 1]]",
        "frames[1].transform_matrix, transposed, correct the file",
    ),
    (
        "/frames/1/transform_matrix",
        "[[1, 0, 0, 2], [0, 1, 0, 3], [0, 0, 1, 4], [0, 0, 0, 2]]",
        "frames[1].transform_matrix, fourth row is [0.0, 0.0, 0.0, 2.0]",
    ),
    (
        "/frames/1/transform_matrix",
        "[[1, 0, 0, 2], [0, 1, 0, 3], [0, 0, 1, 4], [0, 0, 0]]",
        "frames[1].transform_matrix, 4 rows of 4 numbers",
    ),
    ("/ply_file_path", "\"../p.ply\"", "ply_file_path, `..`"),
    ("/ply_file_path", "\"images/a.png\"", "ply_file_path, a.png, not a PLY file, convert"),
    ("/ply_file_path", "\"p.ply\"", "ply_file_path, p.ply"),
    ("/fl_x", "0", "intrinsics, fx"),
    ("/w", "20.5", "w, 20.5"),
    ("/w", "-20", "w, -20"),
    ("/camera_model", "\"EQUIRECTANGULAR\"", "camera_model, EQUIRECTANGULAR, faces of a cube"),
    ("/camera_model", "\"VR180_L\"", "camera_model, VR180_L, image_undistorter"),
    ("/camera_model", "7", "camera_model, string"),
    ("/equirectangular", "true", "transforms.json: equirectangular: the, EQUIRECTANGULAR, cube"),
    ("/frames/2/latlong", "true", "frames[2].latlong, EQUIRECTANGULAR, faces of a cube"),
    ("/ftheta_p1", "0.001", "transforms.json, ftheta_p1, f-theta, fisheye model"),
    ("/white_transparent", "true", "white_transparent, transparent in the images"),
    ("/black_transparent", "true", "black_transparent, transparent in the images"),
    ("/fisheye_crop_radius", "5", "fisheye_crop_radius, not a fisheye, masks/"),
    ("/is_fisheye", "\"false\"", "transforms.json, is_fisheye, neither true nor false"),
    ("/is_fisheye", "2", "transforms.json, is_fisheye, neither true nor false"),
    ("/k4", "0.08", "transforms.json, k4, 0.08, two meanings, FULL_OPENCV, undistort"),
    ("/k1", "-5.0", "folds over, a.png, largest usable field, KeepFieldOfView"),
    ("/k1", "-1e9", "folds over, a.png, calibrate again"),
    ("/k1", "\"x\"", "k1, number"),
];

fn set(json: &mut Value, pointer: &str, value: &str) {
    let (parent, key) = pointer.rsplit_once('/').unwrap();
    let value = (!value.is_empty()).then(|| serde_json::from_str(value).unwrap());
    match (json.pointer_mut(parent).unwrap(), value) {
        (Value::Array(list), Some(value)) => list[key.parse::<usize>().unwrap()] = value,
        (parent, Some(value)) => parent[key] = value,
        (parent, None) => drop(parent.as_object_mut().unwrap().remove(key)),
    }
}

#[test]
fn faults_of_transforms_json_are_named() {
    let options = LoadOptions::default();
    for (pointer, value, words) in TRANSFORMS {
        let made = Made::transforms(|json| set(json, pointer, value));
        refused(&format!("{pointer}: {value}"), &made, &options, words);
    }
    let made = Made::transforms(|json| {
        set(json, "/is_fisheye", "true");
        set(json, "/p2", "0.1");
    });
    refused("p2 of a fisheye", &made, &options, "p2, fisheye, 0.1, image_undistorter");
    let long = format!("\"{}\"", "b".repeat(5000));
    let made = Made::transforms(|json| set(json, "/frames/1/file_path", &long));
    refused("long", &made, &options, "frames[1].file_path, 4 KiB");
    let made = Made::transforms(|json| ["/fl_x", "/fl_y"].iter().for_each(|f| set(json, f, "")));
    refused("no focal length", &made, &options, "fl_x, camera_angle_x");
    let made = Made::transforms(|json| {
        set(json, "/fl_x", "");
        set(json, "/camera_angle_x", "4.0");
    });
    refused("angle", &made, &options, "intrinsics, fx");
    const JSON: &str = "transforms.json";
    edits_are_refused(
        || Made::transforms(|_| ()),
        &[
            (
                "not UTF-8",
                |m| m.patch(JSON, |b| *b.iter_mut().find(|b| **b == b'a').unwrap() = 0xff),
                "transforms.json, save it as UTF-8",
            ),
            (
                "NaN",
                |m| m.replace(JSON, "15.0", "NaN"),
                "transforms.json, line 1, NaN and Infinity, remove the frame",
            ),
            ("deep", |m| m.write(JSON, "[".repeat(100_000)), "transforms.json, JSON"),
            ("points", |m| m.replace("points.ply", "vertex 200", "vertex 201"), "points.ply"),
            (
                "no image at all",
                |m| std::fs::remove_dir_all(m.file("images")).unwrap(),
                "transforms.json, no image",
            ),
        ],
    );
    for (number, is_named) in [("-Infinity", true), ("Infinity", true), ("Nan", false)] {
        let made = Made::transforms(|_| ());
        made.replace("transforms.json", "15.0", number);
        let message = Dataset::load(made.path(), &options).unwrap_err().to_string();
        assert_eq!(message.contains("NaN and Infinity"), is_named, "{number}: {message}");
    }
    let file = made.file("scan.zip");
    std::fs::write(&file, "<html>404</html>").unwrap();
    let message = Dataset::load(&file, &options).unwrap_err().to_string();
    assert!(message.contains("scan.zip") && message.contains("nor a ZIP archive"), "{message}");
}

#[test]
fn unusable_folders_and_splits_are_refused() {
    let empty = tempfile::tempdir().unwrap();
    for (path, word) in [("", "sparse/0/cameras.bin"), ("", "transforms.json"), ("none", "none")] {
        let loaded = Dataset::load(&empty.path().join(path), &LoadOptions::default());
        let message = loaded.unwrap_err().to_string();
        assert!(message.contains(word), "{message}");
    }

    let made = Made::colmap_txt();
    let every_one = LoadOptions { split: Split::Every(NonZeroU32::MIN), ..LoadOptions::default() };
    refused("every view", &made, &every_one, "all 3, LargerTestEvery");
    let other = LoadOptions { images: Some("nowhere".into()), ..LoadOptions::default() };
    refused("no such folder", &made, &other, "nowhere");
    for name in densify_fixtures::NAMES {
        image(&made.file("images_2").join(name), (20, 12), 0);
    }
    let half = LoadOptions { resolution: Some(Resolution::Divisor(2)), ..LoadOptions::default() };
    refused("images_2 is not half", &made, &half, "images_2, 20x12, 10x6");
}

#[cfg(unix)]
#[test]
fn links_out_of_the_dataset_are_refused() {
    let outside = tempfile::tempdir().unwrap();
    for name in densify_fixtures::NAMES {
        image(&outside.path().join(name), densify_fixtures::SIZE, 0);
    }
    let made = Made::colmap_txt();
    std::fs::remove_dir_all(made.file("images")).unwrap();
    std::os::unix::fs::symlink(outside.path(), made.file("images")).unwrap();
    refused("linked folder", &made, &LoadOptions::default(), "symbolic link, OtherImagesFolder");
    let named = LoadOptions { images: Some(outside.path().to_owned()), ..LoadOptions::default() };
    assert!(Dataset::load(made.path(), &named).is_ok());
    // Links inside the dataset are followed.
    let made = Made::colmap_txt();
    std::fs::rename(made.file("images"), made.file("photographs")).unwrap();
    std::os::unix::fs::symlink("photographs", made.file("images")).unwrap();
    assert!(Dataset::load(made.path(), &LoadOptions::default()).is_ok());
}
