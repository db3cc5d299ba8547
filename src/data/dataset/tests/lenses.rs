//! Tests of datasets with distorted lenses and fisheyes.

use glam::DVec3;

use super::super::*;
use super::{assert_noted, load_with, names, refused, write_mask};
use densify_fixtures::{Made, NAMES, SIZE};

const PINHOLE: &str = "PINHOLE 20 12 15 16 10 6";

fn colmap(camera: &str) -> Made {
    let made = Made::colmap_txt();
    made.replace("sparse/0/cameras.txt", PINHOLE, camera);
    made
}

#[test]
fn nerfstudio_and_colmap_lenses_agree() {
    type Fields = &'static [(&'static str, f64)];
    let cases: [(&str, &str, Fields); 4] = [
        (
            "OPENCV_FISHEYE 20 12 15 16 10 6 0.02 -0.01 0.003 0.0004",
            "OPENCV_FISHEYE",
            &[("k1", 0.02), ("k2", -0.01), ("k3", 0.003), ("k4", 0.0004), ("p1", 0.0)],
        ),
        (
            "FULL_OPENCV 20 12 15 16 10 6 0.02 -0.01 0.001 0.002 0.003 0.01 0.02 0.03",
            "OPENCV",
            &[
                ("k1", 0.02),
                ("k2", -0.01),
                ("p1", 0.001),
                ("p2", 0.002),
                ("k3", 0.003),
                ("k4", 0.01),
                ("k5", 0.02),
                ("k6", 0.03),
            ],
        ),
        (
            "FULL_OPENCV 20 12 15 16 10 6 0.02 0 0 0 0 0.01 0 0",
            "FULL_OPENCV",
            &[("k1", 0.02), ("k4", 0.01)],
        ),
        ("SIMPLE_RADIAL_FISHEYE 20 12 15 10 6 0.02", "is_fisheye", &[("fl_y", 15.0), ("k1", 0.02)]),
    ];
    for (camera, model, fields) in cases {
        let made = Made::transforms(|json| {
            match model {
                "is_fisheye" => json["is_fisheye"] = true.into(),
                _ => json["camera_model"] = model.into(),
            }
            for (field, value) in fields {
                json[*field] = (*value).into();
            }
        });
        let options = LoadOptions::default();
        let [a, b] = [load_with(&colmap(camera), &options), load_with(&made, &options)];
        for (a, b) in a.train.iter().zip(&b.train) {
            assert_eq!(a.source.undistortion, b.source.undistortion, "{camera}");
            assert!(a.source.undistortion.is_some());
            assert_eq!((a.camera.fx, a.camera.cx), (b.camera.fx, b.camera.cx), "{camera}");
        }
    }
}

#[test]
fn views_of_one_photograph_share_its_file_and_split() {
    // The field of view is 191 by 115 degrees.
    let made = colmap("OPENCV_FISHEYE 20 12 6 6 10 6 0 0 0 0");
    let every = Split::Every(std::num::NonZeroU32::new(2).unwrap());
    let options =
        LoadOptions { split: every, tracks: TrackReading::Directions, ..LoadOptions::default() };
    let data = load_with(&made, &options);
    let faces = |name: &str| {
        let stem = name.trim_end_matches(".png");
        ["front", "left", "right", "up", "down"].map(|face| format!("{stem}@{face}.png")).to_vec()
    };
    assert_eq!(names(&data.train), faces("b.png"));
    assert_eq!(names(&data.test), [faces("a.png"), faces("c.png")].concat());
    assert_noted(&data, "3 photographs, 5 views");
    // All views are from one place, and the others look at right angles to the front view.
    let front = &data.train[0].camera;
    for view in &data.train[1..] {
        assert!(view.camera.centre().distance(front.centre()) < 1e-12);
        assert!(view.camera.forward().dot(front.forward()).abs() < 1e-12);
        assert_eq!(view.source.file.path, data.train[0].source.file.path);
    }
    let [left, right] = [1, 2].map(|face| data.train[face].camera.forward());
    assert!(left.dot(front.rotation.row(0)) < -0.99 && right.dot(front.rotation.row(0)) > 0.99);
    assert!(data.train[3].camera.forward().dot(front.rotation.row(1)) < -0.99, "up is −y");
    // Every image has the size of its camera, and the colour of its photograph.
    for (resolution, divisor) in [(None, 1), (Some(Resolution::Divisor(2)), 2)] {
        let data = load_with(&made, &LoadOptions { resolution, ..options.clone() });
        for view in data.train.iter().chain(&data.test) {
            let image = view.source.load().unwrap();
            assert_eq!((image.width, image.height), (view.camera.width, view.camera.height));
            assert!(image.bytes() <= view.source.loaded_bytes() && image.mask.is_none());
            let colour = match &view.name[..1] {
                "a" => 0,
                "b" => 40,
                _ => 80,
            };
            assert_eq!(image.rgb, [colour, 100, 200].repeat(image.rgb.len() / 3));
            assert!(view.camera.width <= 12_u32.div_ceil(divisor), "{}", view.camera.width);
        }
    }
}

#[test]
fn a_track_is_in_the_view_that_shows_its_point() {
    let made = colmap("OPENCV_FISHEYE 20 12 6 6 10 6 0 0 0 0");
    // Four photographs see each point; the fourth has the orientation of the first and another position.
    densify_fixtures::image(&made.file("images/d.png"), SIZE, 9);
    let images = std::fs::read_to_string(made.file("sparse/0/images.txt")).unwrap();
    made.write("sparse/0/images.txt", images + "4 1 0 0 0 0.1 0 4 1 d.png\n1 1 -1\n");
    let points = std::fs::read_to_string(made.file("sparse/0/points3D.txt")).unwrap();
    made.write("sparse/0/points3D.txt", points.replace(" 0.1 1 2\n", " 0.1 1 0 2 0 3 0 4 0\n"));
    let data = load_with(
        &made,
        &LoadOptions { tracks: TrackReading::Directions, ..LoadOptions::default() },
    );
    assert!(data.tracks.positions.len() >= 10, "{}", data.tracks.positions.len());
    for (point, views) in data.tracks.positions.iter().zip(&data.tracks.views) {
        for &view in views {
            let camera = &data.train[view as usize].camera;
            let (pixel, depth) = camera.project(*point);
            assert!(depth > 0.0 && pixel.x >= 0.0 && pixel.x < f64::from(camera.width));
        }
        let photographs: Vec<_> =
            views.iter().map(|&v| &data.train[v as usize].name[..1]).collect();
        assert_eq!(photographs, ["a", "b", "c", "d"]);
    }
}

#[test]
fn cropping_is_noted_and_can_be_avoided() {
    let made = colmap("SIMPLE_RADIAL 20 12 15 10 6 -0.2");
    let [cropped, kept] = [false, true]
        .map(|keep_fov| load_with(&made, &LoadOptions { keep_fov, ..LoadOptions::default() }));
    let is_crop = |note: &Note| matches!(note, Note::Cropped { .. });
    assert!(cropped.notes.iter().any(is_crop) && !kept.notes.iter().any(is_crop));
    let [small, large] = [&cropped, &kept].map(|data| data.train[0].source.load().unwrap());
    assert_eq!((small.width, small.height, small.mask), (SIZE.0, SIZE.1, None));
    let mask = large.mask.unwrap();
    assert!(large.width > SIZE.0 && mask.contains(&0) && mask.contains(&255));
    assert_eq!(mask.len(), (large.width * large.height) as usize);
    assert!(kept.train[0].source.loaded_bytes() >= 4 * mask.len() as u64);
    for (pixel, weight) in large.rgb.chunks_exact(3).zip(&mask) {
        assert!(*weight == 0 || pixel == [0, 100, 200], "{pixel:?} {weight}");
    }
    // Cropping changes the field of view, but not the poses or the number of views.
    let [narrow, wide] = [&cropped, &kept].map(|data| data.train[0].camera.project(DVec3::ZERO).1);
    assert_eq!((narrow, cropped.train.len()), (wide, NAMES.len()));
    // If the distortion folds over within the image, the image is used up to the fold.
    let folding = colmap("RADIAL 20 12 15 10 6 -3 0");
    let kept = load_with(&folding, &LoadOptions { keep_fov: true, ..LoadOptions::default() });
    assert_noted(&kept, "beyond what");
}

#[test]
fn views_that_a_mask_hides_are_named_and_left_out() {
    let options = LoadOptions {
        split: Split::Every(std::num::NonZeroU32::new(2).unwrap()),
        ..LoadOptions::default()
    };
    // One photograph is hidden; the others are split as if it were used.
    let made = Made::colmap_txt();
    write_mask(&made.file("masks/a.png"), |_| 0);
    let data = load_with(&made, &options);
    assert_eq!(names(&data.train), ["b.png"]);
    assert_eq!(names(&data.test), ["c.png"]);
    let is_noted = |data: &Dataset, name: &str| {
        data.notes.iter().any(|note| note.contains("masks hide") && note.contains(name))
    };
    assert!(is_noted(&data, "a.png") && !is_noted(&data, "b.png"), "{:?}", data.notes);
    for name in ["masks/b.png", "masks/c.png"] {
        write_mask(&made.file(name), |_| 0);
    }
    refused("all hidden", &made, &options, "all 3, InvertMasks(true)");
    let inverted = LoadOptions { invert_masks: true, ..options.clone() };
    assert_eq!(load_with(&made, &inverted).train.len(), 1);
    // One face of a wide photograph is hidden by masking its left half.
    let made = colmap("OPENCV_FISHEYE 20 12 6 6 10 6 0 0 0 0");
    write_mask(&made.file("masks/b.png"), |x| if x < 10 { 0 } else { 255 });
    let data = load_with(&made, &options);
    let faces = ["front", "right", "up", "down"].map(|face| format!("b@{face}.png"));
    assert_eq!(names(&data.train), faces);
    assert!(is_noted(&data, "b@left.png"), "{:?}", data.notes);
    for view in &data.train {
        assert!(view.source.load().unwrap().mask.unwrap().iter().any(|&weight| weight > 0));
    }
}

/// What lies outside of nerfstudio's `fisheye_crop_radius` is cropped or, on request, masked: here, it is white, and
/// the circle is black.
#[test]
fn nothing_outside_of_the_image_circle_is_used() {
    const RADIUS: f64 = 5.0;
    let made = |radius: Option<f64>| {
        let made = Made::transforms(|json| {
            json["camera_model"] = "OPENCV_FISHEYE".into();
            json["fl_y"] = 15.0.into();
            json["fisheye_crop_radius"] = radius.into();
        });
        for name in NAMES {
            let is_inside = |x: u32, y: u32| {
                let offset = [f64::from(x) + 0.5 - 10.0, f64::from(y) + 0.5 - 6.0];
                // Interpolation reaches two pixels beyond a point.
                offset[0].hypot(offset[1]) < RADIUS + 3.0
            };
            let pixel = |x, y| [if is_inside(x, y) { 0 } else { 255 }; 3].into();
            let image = image::RgbImage::from_fn(SIZE.0, SIZE.1, pixel);
            image.save(made.file("images").join(name)).unwrap();
        }
        made
    };
    let largest = |image: &densify_core::image::Image8| {
        let weight = |index| image.mask.as_ref().map_or(255, |mask| mask[index]);
        let pixels = image.rgb.chunks_exact(3).enumerate();
        pixels.filter(|(index, _)| weight(*index) > 0).map(|(_, pixel)| pixel[0]).max().unwrap()
    };
    for keep_fov in [false, true] {
        let options = LoadOptions { keep_fov, ..LoadOptions::default() };
        for (radius, is_cut) in [(None, false), (Some(RADIUS), true), (Some(12.0), false)] {
            let made = made(radius);
            let data = load_with(&made, &options);
            let source = &data.train[0].source;
            assert_eq!(format!("{:?}", source.undistortion).contains("circle"), is_cut);
            let image = source.load().unwrap();
            assert_eq!(largest(&image) == 0, is_cut, "{keep_fov}, {radius:?}");
            assert_eq!(image.mask.is_some(), keep_fov, "{radius:?}");
            // At half the resolution, the circle has half the radius.
            let resolution = Some(Resolution::Divisor(2));
            let data = load_with(&made, &LoadOptions { resolution, ..options.clone() });
            let image = data.train[0].source.load().unwrap();
            assert_eq!(largest(&image) == 0, is_cut, "half, {keep_fov}, {radius:?}");
        }
    }
}
