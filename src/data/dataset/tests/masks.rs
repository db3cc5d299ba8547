//! Tests of the places where masks are found, and of what masks hide.

use super::super::*;
use super::{assert_noted, load, load_with, refused, write_mask};
use densify_fixtures::{Made, NAMES, SIZE, image};

#[test]
fn masks_are_found_under_all_usual_names() {
    for (made, mask) in [
        (Made::colmap_txt(), "masks/b.png.png"),
        (Made::colmap_txt(), "masks/b.png"),
        (Made::transforms(|_| ()), "masks/b.png"),
        (Made::colmap_txt(), "masks/b.mask.png"),
        (Made::colmap_txt(), "mask/b.png"),
        (Made::transforms(|_| ()), "segmentation/b.png.png"),
        (Made::colmap_txt(), "dynamic_masks/b.png"),
        (Made::realitycapture(), "masks/b.png.mask.png"),
        (Made::realitycapture(), "images/b.png.mask.png"),
        (Made::colmap_txt(), "images/b.mask.png"),
        (Made::colmap_txt(), "images/b_mask.png"),
        (Made::transforms(|_| ()), "images/b_mask.png"),
        (Made::colmap_txt(), "Masks/b.png"),
        (Made::transforms(|_| ()), "MASK/b.png"),
        (Made::transforms(|_| ()), "images/.mask/b.png"),
        (
            Made::transforms(|json| json["frames"][1]["mask_path"] = "elsewhere/m.png".into()),
            "elsewhere/m.png",
        ),
    ] {
        write_mask(&made.file(mask), |x| if x < 10 { 0 } else { 255 });
        let data = load(&made);
        assert_noted(&data, "1 of 3 photographs have a mask");
        assert_eq!(data.train[0].source.load().unwrap().mask, None, "{mask}");
        let found = data.train[1].source.load().unwrap().mask.unwrap();
        assert_eq!((found[0], found[19]), (0, 255), "{mask}");
        let inverted = LoadOptions { invert_masks: true, ..LoadOptions::default() };
        let data = load_with(&made, &inverted);
        let found = data.train[1].source.load().unwrap().mask.unwrap();
        assert_eq!((found[0], found[19]), (255, 0), "{mask}");
        let background = LoadOptions { mask_mode: MaskMode::Background, ..LoadOptions::default() };
        let source = &load_with(&made, &background).train[1].source;
        let found = source.load().unwrap();
        let alpha = found.alpha.as_ref().unwrap();
        assert_eq!((alpha[0], alpha[19], &found.mask), (0, 255, &None), "{mask}");
        assert_eq!(found.bytes(), source.loaded_bytes());
    }
}

/// Photographs may have names like those of masks of others.
#[test]
fn listed_photographs_are_no_masks() {
    let name = "a_mask.png";
    let transforms = Made::transforms(|json| {
        json["frames"][1]["file_path"] = format!("images/{name}").into();
    });
    let (colmap, table) = (Made::colmap_txt(), Made::realitycapture());
    colmap.replace("sparse/0/images.txt", "b.png", name);
    table.replace("cameras.csv", "b.png", name);
    for made in [transforms, colmap, table] {
        let photograph = made.file(&format!("images/{name}"));
        std::fs::rename(made.file("images/b.png"), &photograph).unwrap();
        let options = LoadOptions { images: Some("./images".into()), ..LoadOptions::default() };
        for options in [LoadOptions::default(), options] {
            let data = load_with(&made, &options);
            assert!(
                data.train.iter().all(|view| view.source.mask.is_none()) && data.train.len() == 3
            );
        }
        // The next of the usual names counts.
        write_mask(&made.file("images/dynamic_mask_a.png"), |x| u8::from(x < 10));
        let mask = load(&made).train[0].source.mask.clone().expect("a mask");
        assert!(mask.file.path.ends_with("dynamic_mask_a.png"), "{}", mask.file.path.display());
    }
    // With reduced photographs, the full-size ones are no masks either.
    let made = Made::colmap_txt();
    made.replace("sparse/0/images.txt", "b.png", name);
    std::fs::rename(made.file("images/b.png"), made.file("images/a_mask.png")).unwrap();
    for name in ["a.png", name, "c.png"] {
        image(&made.file("images_2").join(name), (10, 6), 7);
    }
    let half = LoadOptions { resolution: Some(Resolution::Divisor(2)), ..LoadOptions::default() };
    assert!(load_with(&made, &half).train.iter().all(|view| view.source.mask.is_none()));
}

/// Photographs for training and for tests have the same names in two folders, as in NeRF-synthetic scenes.
#[test]
fn masks_belong_to_photographs_of_one_split() {
    let made = |test: &str, masks: [Option<&str>; 2]| {
        let made = Made::transforms(|_| ());
        let json: serde_json::Value =
            serde_json::from_slice(&std::fs::read(made.file("transforms.json")).unwrap()).unwrap();
        for (at, (file, listed)) in
            [("transforms_train.json", "train/r_0"), ("transforms_test.json", test)]
                .into_iter()
                .enumerate()
        {
            let mut part = json.clone();
            let mut frame = json["frames"][at].clone();
            frame["file_path"] = format!("./{listed}").into();
            if let Some(mask) = masks[at] {
                frame["mask_path"] = mask.into();
            }
            part["frames"] = vec![frame].into();
            made.write(file, part.to_string());
            image(&made.file(&format!("{listed}.png")), SIZE, 9);
        }
        made
    };
    let masked = |made: &Made, options: &LoadOptions| {
        let data = load_with(made, options);
        assert_eq!((data.train.len(), data.test.len()), (1, 1));
        [&data.train, &data.test].map(|views| views[0].source.mask.is_some())
    };
    let plain = LoadOptions::default();
    for (mask, expected) in [
        ("masks/train/r_0.png", [true, false]),
        ("masks/test/r_0.png", [false, true]),
        ("masks/r_0.png", [false, false]),
        ("train/r_0_mask.png", [true, false]),
        ("test/r_0.mask.png", [false, true]),
        ("test/dynamic_mask_r_0.png", [false, true]),
    ] {
        let made = made("test/r_0", [None; 2]);
        write_mask(&made.file(mask), |x| if x < 10 { 0 } else { 255 });
        assert_eq!(masked(&made, &plain), expected, "{mask}");
    }
    for (masks, expected) in [
        ([None, Some("m/b.png")], [false, true]),
        ([Some("./m/b.png"), None], [true, false]),
        ([Some("m/b.png"), Some("m/b.png")], [true, true]),
    ] {
        let made = made("test/r_0", masks);
        write_mask(&made.file("m/b.png"), |_| 255);
        assert_eq!(masked(&made, &plain), expected, "{masks:?}");
    }
    // A photograph for tests is no mask of one for training.
    assert_eq!(masked(&made("train/r_0_mask", [None; 2]), &plain), [false, false]);
    // Paths of another machine lead to the masks of their own folders, or are refused.
    let own = ["/x/train/masks/r_0.png", "/x/test/masks/r_0.png"].map(Some);
    let there = LoadOptions { images: Some(".".into()), ..LoadOptions::default() };
    let separate = made("test/r_0", own);
    for file in ["train/masks/r_0.png", "test/masks/r_0.png"] {
        write_mask(&separate.file(file), |_| 255);
    }
    assert_eq!(masked(&separate, &there), [true, true]);
    let shared = made("test/r_0", own);
    write_mask(&shared.file("masks/r_0.png"), |_| 255);
    let words = "mask_path, /x/train/masks/r_0.png, /x/test/masks/r_0.png, copy the folders";
    refused("one file", &shared, &there, words);
}

#[test]
fn folders_whose_masks_belong_to_no_photograph_are_noted() {
    for file in ["masks/other.png", "images/masks/b.png", "Segmentation/other.png"] {
        let made = Made::colmap_txt();
        image(&made.file(file), SIZE, 200);
        let folder = file.rsplit_once('/').unwrap().0;
        assert_noted(&load(&made), &format!("{folder}, no mask of any photograph"));
    }
    assert!(!load(&Made::colmap_txt()).notes.iter().any(|note| note.contains("mask")));
}

/// In masks of instant-ngp every value but black hides pixels.
#[test]
fn dynamic_masks_are_found_beside_photographs() {
    for made in [Made::colmap_txt(), Made::transforms(|_| ())] {
        write_mask(&made.file("images/dynamic_mask_b.png"), |x| u8::from(x >= 10));
        for (invert_masks, expected) in [(false, (255, 0)), (true, (0, 255))] {
            let options = LoadOptions { invert_masks, ..LoadOptions::default() };
            let data = load_with(&made, &options);
            assert_eq!(data.train[0].source.load().unwrap().mask, None);
            let found = data.train[1].source.load().unwrap().mask.unwrap();
            assert_eq!((found[0], found[19]), expected, "{invert_masks}");
        }
    }
}

/// Masks are in the dataset's `masks/` or beside the photographs, and are never taken for photographs.
#[test]
fn masks_are_found_if_the_options_name_an_image_folder() {
    // Each mask is preferred to the following ones, and then removed.
    let masks = [
        "masks/b.png.png",
        "masks/b.png",
        "masks/b.jpg",
        "masks/b.jpeg",
        "masks/b.png.mask.png",
        "masks/b.mask.png",
        "moved/b.png.mask.png",
        "moved/b.mask.png",
        "moved/b_mask.png",
        "moved/.mask/b.png",
        "moved/dynamic_mask_b.png",
    ];
    for made in [Made::colmap_txt(), Made::transforms(|_| ()), Made::realitycapture()] {
        std::fs::rename(made.file("images"), made.file("moved")).unwrap();
        masks.iter().for_each(|mask| image(&made.file(mask), SIZE, 200));
        // In this mask, every value but black hides a pixel.
        write_mask(&made.file("moved/dynamic_mask_b.png"), |_| 0);
        let options = LoadOptions { images: Some("moved".into()), ..LoadOptions::default() };
        for mask in masks {
            let data = load_with(&made, &options);
            let found = data.train[1].source.mask.clone().expect(mask);
            assert!(found.file.path.ends_with(mask), "{mask}: {}", found.file.path.display());
            let dynamic = found.hides == images::Hides::AllButBlack;
            assert_eq!(dynamic, mask.contains("dynamic"), "{mask}");
            assert!(data.train[0].source.mask.is_none() && data.train.len() == 3);
            assert!(!data.notes.iter().any(|note| note.contains("poses")), "{:?}", data.notes);
            made.remove(mask);
        }
    }
    // Masks beside the reduced photographs, or beside the full-size ones.
    let made = Made::colmap_txt();
    for name in NAMES {
        image(&made.file("images_2").join(name), (10, 6), 7);
    }
    let half = LoadOptions { resolution: Some(Resolution::Divisor(2)), ..LoadOptions::default() };
    for mask in ["images/b.png.mask.png", "images_2/b.png.mask.png"] {
        image(&made.file(mask), (10, 6), 200);
        let found = load_with(&made, &half).train[1].source.mask.clone().expect(mask);
        assert!(found.file.path.ends_with(mask), "{mask}");
    }
}
