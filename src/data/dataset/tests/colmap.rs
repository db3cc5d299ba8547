//! Tests of unusual COLMAP models: several in one dataset, without points, or written by other programs.

use std::fs;

use super::super::*;
use super::{assert_noted, load, load_with, names, refused};
use densify_fixtures::{Made, SIZE, image};

/// Copies a model with only the first `images` of its images.
fn copy(made: &Made, from: &str, to: &str, images: usize) {
    fs::create_dir_all(made.file(to)).unwrap();
    for entry in fs::read_dir(made.file(from)).unwrap() {
        let entry = entry.unwrap();
        fs::copy(entry.path(), made.file(to).join(entry.file_name())).unwrap();
    }
    let file = format!("{to}/images.txt");
    if made.file(&file).is_file() {
        let text = fs::read_to_string(made.file(&file)).unwrap();
        let lines: Vec<&str> = text.lines().take(1 + 2 * images).collect();
        made.write(&file, lines.join("\n"));
    } else {
        // Each image has a name of five letters and two observations.
        made.patch(&format!("{to}/images.bin"), |bytes| {
            bytes[0] = images as u8;
            bytes.truncate(8 + images * (4 + 56 + 4 + 6 + 8 + 48));
        });
    }
}

fn other_models(data: &Dataset) -> Option<&Note> {
    data.notes.iter().find(|note| matches!(note, Note::OtherModels { .. }))
}

#[test]
fn the_largest_of_several_models_is_read() {
    for made in [Made::colmap_txt(), Made::colmap_bin()] {
        copy(&made, "sparse/0", "sparse/10", 3);
        copy(&made, "sparse/0", "sparse/2", 2);
        copy(&made, "sparse/10", "sparse/0", 1);
        let data = load(&made);
        assert_eq!(data.train.len(), 3);
        let others = vec![("sparse/0".to_owned(), 1), ("sparse/2".to_owned(), 2)];
        let note = Note::OtherModels { model: "sparse/10".to_owned(), images: 3, others };
        assert_eq!(other_models(&data), Some(&note));
        assert!(!data.notes.iter().any(|note| note.contains("poses of")), "{:?}", data.notes);
        let chosen = LoadOptions { sparse: Some("sparse/2".into()), ..LoadOptions::default() };
        let data = load_with(&made, &chosen);
        assert_eq!((names(&data.train), other_models(&data)), (vec!["a.png", "b.png"], None));
        assert_noted(&data, "sparse/2 has the poses of 2 of 3 images");
        // Of models with equally many images, the first is read; there need not be a model 0.
        fs::remove_dir_all(made.file("sparse/0")).unwrap();
        copy(&made, "sparse/10", "sparse/9", 3);
        let others = vec![("sparse/2".to_owned(), 2), ("sparse/10".to_owned(), 3)];
        let note = Note::OtherModels { model: "sparse/9".to_owned(), images: 3, others };
        assert_eq!(other_models(&load(&made)), Some(&note));
        for model in ["sparse/9", "sparse/10"] {
            fs::remove_dir_all(made.file(model)).unwrap();
        }
        let data = load(&made);
        assert_eq!((data.train.len(), other_models(&data)), (2, None));
        let chosen = LoadOptions { sparse: Some("sparse/7".into()), ..LoadOptions::default() };
        refused("no such model", &made, &chosen, "sparse/7, the dataset has sparse/2, ColmapModel");
    }
}

/// nerfstudio's own file has the same cameras, and takes precedence unless the model is chosen.
#[test]
fn the_model_may_be_where_nerfstudio_puts_it() {
    let made = Made::transforms(|_| ());
    let colmap = Made::colmap_bin();
    fs::create_dir_all(made.file("colmap")).unwrap();
    fs::rename(colmap.file("sparse"), made.file("colmap/sparse")).unwrap();
    copy(&made, "colmap/sparse/0", "colmap/sparse/1", 2);
    assert_eq!(names(&load(&made).train)[0], "images/a.png");
    let sparse = Some("colmap/sparse/1".into());
    let data = load_with(&made, &LoadOptions { sparse, ..LoadOptions::default() });
    assert_eq!(names(&data.train), ["a.png", "b.png"]);
    made.remove("transforms.json");
    assert_eq!(names(&load(&made).train), ["a.png", "b.png", "c.png"]);
}

#[test]
fn a_model_may_have_no_points() {
    for made in [Made::colmap_txt(), Made::colmap_bin()] {
        for extension in ["txt", "bin"] {
            let _ = fs::remove_file(made.file(&format!("sparse/0/points3D.{extension}")));
        }
        let tracks = LoadOptions { tracks: TrackReading::Directions, ..LoadOptions::default() };
        let data = load_with(&made, &tracks);
        assert_eq!((data.train.len(), data.points.len()), (3, 0));
        assert_noted(&data, "points3D, does not exist");
        // Points as text beside binary cameras.
        made.write("sparse/0/points3D.txt", "1 0 0 1 10 20 30 0.1\n");
        assert_eq!(load(&made).points.colours, [[10, 20, 30]]);
    }
}

/// Some programs leave out all lines of observations, others only the empty lines.
#[test]
fn images_may_have_no_line_of_observations() {
    for name in ["b.png", "b 2.png", "my b 2.png", "1 2 3 b.png"] {
        let text = |second: [&str; 3]| {
            let [a, b, c] = second;
            format!(
                "# images\n1 1 0 0 0 0 0 4 1 a.png\n{a}2 0.8 0 0.6 0 0.5 0 4 1 {name}\n{b}# more\n\
                 3 0 0 1 0 0 0.25 5 1 c.png{c}"
            )
        };
        for second in [
            ["", "", ""],
            ["\n", "\n", "\n\n"],
            ["", "1.5 2.5 -1 3 4 7\n", "\r\n"],
            ["1.5 2.5 -1 3 4 7 1 1 1 2 2 2\n", "", "\n1.5 2.5 -1"],
        ] {
            let made = Made::colmap_txt();
            image(&made.file("images").join(name), SIZE, 40);
            made.write("sparse/0/images.txt", text(second));
            let data = load(&made);
            let mut expected = vec!["a.png", name, "c.png"];
            expected.sort_unstable();
            assert_eq!(names(&data.train), expected, "{second:?}");
        }
    }
}

#[test]
fn photographs_without_a_pose_are_counted_wherever_they_are() {
    let made = Made::colmap_txt();
    for file in ["d.JPG", "rig/left/e.png"] {
        made.write(&format!("images/{file}"), "");
    }
    for file in [
        "Thumbs.db",
        ".hidden.png",
        "a.mask.png",
        "a_mask.png",
        "masks/d.png",
        "Mask/d.png",
        ".cache/d.png",
    ] {
        made.write(&format!("images/{file}"), "");
    }
    respell_name(&made);
    assert_noted(&load(&made), "3 of 5 images, the others are not used");
    // If the dataset's own folder is chosen as the folder of photographs, its subfolders are not searched.
    let images = Some(".".into());
    for name in ["\u{e4}.png", "b.png", "c.png", "other.png"] {
        image(&made.file(name), SIZE, 0);
    }
    let data = load_with(&made, &LoadOptions { images, ..LoadOptions::default() });
    assert_noted(&data, "3 of 4 images");
    // Only reduced photographs exist.
    let made = Made::colmap_txt();
    fs::create_dir(made.file("images_2")).unwrap();
    for name in densify_fixtures::NAMES.iter().chain(&["d.png"]) {
        image(&made.file("images_2").join(name), (10, 6), 0);
    }
    fs::remove_dir_all(made.file("images")).unwrap();
    let resolution = Some(Resolution::Divisor(2));
    let data = load_with(&made, &LoadOptions { resolution, ..LoadOptions::default() });
    assert_noted(&data, "3 of 4 images");
}

/// Gives a file a name whose Unicode spelling differs from that in the list.
fn respell_name(made: &Made) {
    fs::rename(made.file("images/a.png"), made.file("images/\u{e4}.png")).unwrap();
    made.replace("sparse/0/images.txt", "a.png", "a\u{308}.png");
}

/// Names of the training views and of the test views.
fn split(made: &Made, split: Split) -> [Vec<String>; 2] {
    let data = load_with(made, &LoadOptions { split, ..LoadOptions::default() });
    [&data.train, &data.test].map(|views| names(views).into_iter().map(str::to_owned).collect())
}

fn assert_split(made: &Made, train: &[&str], test: &[&str]) {
    assert_eq!(split(made, Split::Eval), [train, test]);
}

#[test]
fn lists_of_other_trainers_define_the_split() {
    let made = Made::colmap_txt();
    // Without lists, every eighth photograph is held out; a list without names is none.
    assert_split(&made, &["b.png", "c.png"], &["a.png"]);
    made.write("test_list.txt", "\n");
    assert_split(&made, &["b.png", "c.png"], &["a.png"]);
    made.write("test_list.txt", "c.png\n");
    assert_split(&made, &["a.png", "b.png"], &["c.png"]);
    made.write("train_list.txt", "b.png\n");
    assert_split(&made, &["b.png"], &["c.png"]);
    let eval = LoadOptions { split: Split::Eval, ..LoadOptions::default() };
    assert_noted(&load_with(&made, &eval), "test_list.txt holds out 1 of 3 photographs");
    assert_noted(&load_with(&made, &eval), "1 of 3 photographs are in neither list");
    made.remove("test_list.txt");
    assert_split(&made, &["b.png"], &["a.png", "c.png"]);
    made.write("test_list.txt", "b.png\n");
    assert_split(&made, &["b.png"], &["b.png"]);
    // The list beside the model takes precedence. Extensions may differ, and Windows ends lines with two characters.
    made.write("sparse/0/test.txt", "a.JPG\r\n\r\nimages\\b\r\n");
    assert_split(&made, &["c.png"], &["a.png", "b.png"]);
    assert_noted(&load_with(&made, &eval), "sparse/0/test.txt holds out 2 of 3 photographs");
    let chosen = LoadOptions { sparse: Some("sparse/0".into()), ..eval.clone() };
    assert_eq!(load_with(&made, &chosen).test.len(), 2);
    // Options take precedence over lists; without them, nothing is held out.
    let every = Split::Every(std::num::NonZeroU32::new(2).unwrap());
    let [a, b, c] = ["a.png", "b.png", "c.png"].map(str::to_owned);
    assert_eq!(split(&made, every), [vec![b.clone()], vec![a.clone(), c.clone()]]);
    assert_eq!(split(&made, Split::None), [vec![a, b, c], vec![]]);
}

#[test]
fn lists_that_do_not_fit_are_refused_or_noted() {
    let eval = LoadOptions { split: Split::Eval, ..LoadOptions::default() };
    let made = Made::colmap_txt();
    made.write("sparse/0/test.txt", "b.png\nnone.png\n");
    assert_noted(&load_with(&made, &eval), "sparse/0/test.txt: 1 of 2 names, first: none.png");
    made.write("sparse/0/test.txt", "none.png\nd.png\n");
    refused("none", &made, &eval, "test.txt, names none of the model's, none.png");
    made.write("sparse/0/test.txt", "a\nb\nc\n");
    refused("all", &made, &eval, "test.txt, leaves no photograph to train on");
}
