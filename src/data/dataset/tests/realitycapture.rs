//! Tests of RealityCapture's table of cameras: poses against hand-computed ones and COLMAP's, and damaged tables.

use glam::DVec3;

use super::super::*;
use super::{assert_noted, edits_are_refused, load, names, refused};
use densify_fixtures::{Made, SIZE, image};

const TABLE: &str = "cameras.csv";

#[test]
fn cameras_agree_with_those_of_the_same_scene_in_colmap_format() {
    let (colmap, table) = (load(&Made::colmap_txt()), load(&Made::realitycapture()));
    assert_eq!(table.points.colours, colmap.points.colours);
    assert_eq!(table.train.len(), 3);
    for (a, b) in colmap.train.iter().zip(&table.train) {
        assert_eq!(b.name, format!("images/{}", a.name));
        let (a, b) = (&a.camera, &b.camera);
        assert!((a.rotation - b.rotation).to_cols_array().iter().all(|e| e.abs() < 1e-12));
        assert!((a.translation - b.translation).length() < 1e-12);
        assert_eq!((b.width, b.height, b.cx, b.cy), (SIZE.0, SIZE.1, 10.0, 6.0));
        assert!((b.fx - 15.0).abs() < 1e-12 && b.fx == b.fy, "{}", b.fx);
    }
}

/// According to the documentation, with all angles 0 a camera looks straight down and its upper side points north.
#[test]
fn heading_pitch_and_roll_turn_the_camera_as_documented() {
    let (east, north, up) = (DVec3::X, DVec3::Y, DVec3::Z);
    // Angles, the viewing direction, and the direction of the upper side of the image.
    for (angles, forward, upper) in [
        ("0,0,0", -up, north),
        ("90,0,0", -up, east),
        ("0,90,0", north, up),
        ("90,90,0", east, up),
        ("180,90,0", -north, up),
        ("0,0,90", -east, north),
        ("0,45,0", (north - up).normalize(), (north + up).normalize()),
    ] {
        let made = Made::realitycapture();
        let text = std::fs::read_to_string(made.file(TABLE)).unwrap();
        let lines = text.lines().map(|line| {
            let mut cells: Vec<&str> = line.split(',').collect();
            if line.starts_with("images/") {
                cells.splice(4..7, angles.split(','));
            }
            cells.join(",") + "\r\n"
        });
        made.write(TABLE, lines.collect::<String>());
        let camera = load(&made).train[0].camera;
        let down = camera.rotation.row(1);
        assert!(camera.forward().distance(forward) < 1e-12, "{angles}: {}", camera.forward());
        assert!(down.distance(-upper) < 1e-12, "{angles}: {down}");
    }
}

/// The longer side is 36 mm, also in portrait format; the principal point is relative to the centre.
#[test]
fn lengths_are_relative_to_the_longer_side() {
    let made = Made::realitycapture();
    image(&made.file("images/b.png"), (12, 20), 9);
    made.replace(TABLE, ",27,0,0,", ",27,0.05,-0.1,");
    let data = load(&made);
    let [a, b] = [0, 1].map(|view| data.train[view].camera);
    assert_eq!((a.cx, a.cy), (11.0, 4.0));
    assert_eq!((b.width, b.height, b.cx, b.cy), (12, 20, 6.0, 10.0));
    assert!((b.fx - 15.0).abs() < 1e-12);
}

/// Replaces the positions of the three cameras.
fn moved(centres: [[f64; 3]; 3]) -> Made {
    let made = Made::realitycapture();
    let text = std::fs::read_to_string(made.file(TABLE)).unwrap();
    let mut centres = centres.iter();
    let lines = text.lines().map(|line| {
        let mut cells: Vec<String> = line.split(',').map(str::to_owned).collect();
        if line.starts_with("images/") {
            cells.splice(1..4, centres.next().unwrap().map(|value| value.to_string()));
        }
        cells.join(",") + "\n"
    });
    made.write(TABLE, lines.collect::<String>());
    made
}

#[test]
fn coordinates_in_degrees_are_refused() {
    let (lon, lat) = (-34.828_786_5, -7.163_311_9);
    let made = moved([[lon, lat, 85.0], [lon + 1e-4, lat, 84.5], [lon, lat + 2e-4, 85.25]]);
    refused("degrees", &made, &LoadOptions::default(), "cameras.csv, x, y, degrees, local:1");
    // A few centimetres around a small object, a flight at almost constant height, and a lift, in metres.
    for centres in [
        [[0.1, 0.2, 0.0], [0.1, 0.21, 1.5], [0.1, 0.2, 3.0]],
        [[2.0, 1.0, 0.0], [2.05, 1.0, 0.02], [2.0, 1.05, 0.5]],
        [[0.0, 0.0, 85.0], [50.0, 0.0, 84.5], [0.0, 50.0, 85.25]],
    ] {
        assert_eq!(load(&moved(centres)).train.len(), 3);
    }
}

/// RealityScan 2 has other names for the same columns.
#[test]
fn tables_of_realityscan_load_the_same() {
    let (older, newer) = (Made::realitycapture(), Made::realitycapture());
    newer.replace(TABLE, "heading", "yaw");
    newer.replace(TABLE, ",f,px,py,", ",f_35mm,px_norm,py_norm,");
    for made in [&older, &newer] {
        made.replace(TABLE, ",27,0,0,", ",27,0.05,-0.1,");
    }
    for (a, b) in load(&older).train.iter().zip(&load(&newer).train) {
        assert_eq!((&a.name, a.camera), (&b.name, b.camera));
    }
}

/// The table's k1, k2, t1 and t2 are k1, k2, p2 and p1 of COLMAP's OPENCV model.
#[test]
fn distortion_agrees_with_other_formats() {
    let made = Made::realitycapture();
    let text = std::fs::read_to_string(made.file(TABLE)).unwrap();
    made.write(TABLE, text.replace(",27,0,0,0,0,0,0,0,0", ",27,0,0,0.02,-0.01,0,0,0.001,0.002"));
    let colmap = Made::colmap_txt();
    let camera = "OPENCV 20 12 15 15 10 6 0.02 -0.01 0.002 0.001";
    colmap.replace("sparse/0/cameras.txt", "PINHOLE 20 12 15 16 10 6", camera);
    for (a, b) in load(&colmap).train.iter().zip(&load(&made).train) {
        assert!(a.source.undistortion.is_some());
        assert_eq!(a.source.undistortion, b.source.undistortion);
    }
    // k3 and k4 are used as well.
    let with = |from: &str, to: &str| {
        let made = Made::realitycapture();
        made.replace(TABLE, from, to);
        load(&made).train[0].source.undistortion
    };
    let none = ",27,0,0,0,0,0,0,0,0";
    let some = [with(none, ",27,0,0,0,0,0.05,0,0,0"), with(none, ",27,0,0,0,0,0,0.05,0,0")];
    assert!(some[0].is_some() && some[1].is_some() && some[0] != some[1]);
}

#[test]
fn names_may_contain_commas_spaces_and_other_scripts_and_omit_the_folder_images() {
    let made = Made::realitycapture();
    let text = std::fs::read_to_string(made.file(TABLE)).unwrap();
    let text = text.replace("images/a.png", "\"Küche, Süd (1).png\"").replace("images/", "");
    made.write("Export 1.CSV", text);
    made.remove(TABLE);
    std::fs::rename(made.file("images/a.png"), made.file("images/Küche, Süd (1).png")).unwrap();
    // A table without cameras is ignored.
    made.write("notes.csv", "a,b\n1,2\n");
    let data = load(&made);
    assert_eq!(names(&data.train), ["Küche, Süd (1).png", "b.png", "c.png"]);
    // A missing photograph is skipped.
    made.remove("images/c.png");
    let data = load(&made);
    assert_eq!(data.train.len(), 2);
    assert_noted(&data, "1 of 3 photographs, c.png");
}

#[test]
fn damaged_tables_are_refused_by_line_and_column() {
    for (old, new, words) in [
        (",27,", ",wide,", "cameras.csv, line 3: f, \"wide\" is not a number, export"),
        (",27,", ",,", "cameras.csv, line 3: f, \"\" is not a number"),
        (",27,", ",0,", "cameras.csv, line 3 (images/a.png), fx"),
        (",27,", ",-27,", "line 3 (images/a.png), fx"),
        (",27,", ",1e9,", "line 3 (images/a.png), field of view"),
        (",27,0,", ",27,9,", "cameras.csv, images/a.png, principal point"),
        (",27,0,0,0,", ",27,0,0,nan,", "line 3 (images/a.png), not finite"),
        (",27,0,0,0,", ",27,0,0,-9,", "a.png, folds over, largest usable field"),
        ("images/b.png,", "images/b.png,nan", "line 4: x, not a number"),
        ("images/b.png", "../b.png", "cameras.csv, line 4: name, `..`"),
        ("images/b.png", "/b.png", "cameras.csv, line 4: name, absolute"),
    ] {
        let made = Made::realitycapture();
        made.replace(TABLE, old, new);
        refused(new, &made, &LoadOptions::default(), words);
    }
    edits_are_refused(
        Made::realitycapture,
        &[
            (
                "two",
                |m| m.write("d.csv", std::fs::read(m.file(TABLE)).unwrap()),
                "cameras.csv, d.csv",
            ),
            ("no names", |m| m.replace(TABLE, "#name", "#label"), "is not a dataset, .csv"),
            ("only names", |m| m.write(TABLE, "#name,x,y,alt,heading,pitch,roll,f\n"), "no image"),
            (
                "no photographs",
                |m| std::fs::remove_dir_all(m.file("images")).unwrap(),
                "cameras.csv, no image, a.png, AddOrImagesFolder",
            ),
            (
                "other photographs",
                |m| {
                    for name in ["a", "b", "c"] {
                        let image = m.file(&format!("images/{name}.png"));
                        std::fs::rename(&image, image.with_extension("webp")).unwrap();
                    }
                },
                "cameras.csv, no image, a.png; a.webp exists",
            ),
            ("not an image", |m| m.write("images/b.png", "hello"), "images/b.png, decode"),
            (
                "a far-off camera",
                |m| m.replace(TABLE, "images/a.png,", "images/a.png,1e308"),
                "line 3",
            ),
        ],
    );
}
