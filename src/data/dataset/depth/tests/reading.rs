//! Tests of files of depth: formats, sizes, confidences, points, and damage.

use super::*;

#[test]
fn true_depth_is_read_at_every_resolution_and_agrees_with_the_points() {
    let room = Room::new();
    let data = room.load(&with(on())).unwrap();
    let found = data.depth.as_ref().unwrap();
    assert_eq!((found.source, found.views, found.of_views), (DepthOrigin::Maps, 8, 8));
    assert!((found.scale - 1.0).abs() < 0.01 && !found.is_corrected, "{found:?}");
    assert!(found.points > 300 && found.known > 0.5, "{found:?}");
    assert!(data.test.iter().all(|view| view.source.depth.is_none()));
    let whole = stored(&room.arrays()[3]);
    let (worst, counted) = error(&data, 3, |x, y| whole[(x, y)].0[0] / 1000.0);
    assert!(worst < 0.002 && counted > 0.6, "{worst} {counted}");
    let small = LoadOptions { resolution: Some(Resolution::Divisor(2)), ..with(on()) };
    let data = room.load(&small).unwrap();
    // A pixel's centre is the corner of four; the first of them counts.
    let (worst, counted) = error(&data, 3, |x, y| whole[(2 * x + 1, 2 * y + 1)].0[0] / 1000.0);
    assert!(worst < 0.002 && counted > 0.4, "{worst} {counted}");
}

#[test]
fn views_without_depth_are_counted_and_confidence_is_read() {
    let room = Room::new();
    std::fs::remove_file(&room.arrays()[0]).unwrap();
    std::fs::remove_file(room.arrays()[0].with_file_name("0000.exr")).ok();
    let exr: Vec<PathBuf> =
        room.path().join("depth/train").read_dir().unwrap().map(|e| e.unwrap().path()).collect();
    for path in exr.iter().filter(|path| path.extension().is_some_and(|e| e == "exr")) {
        let _ = std::fs::remove_file(path);
    }
    let stem = room.arrays()[0].file_stem().unwrap().to_str().unwrap().to_owned();
    let confidence = room.path().join(format!("confidence/train/{stem}.png"));
    std::fs::create_dir_all(confidence.parent().unwrap()).unwrap();
    image::GrayImage::from_fn(SIDE, SIDE, |x, _| [(3 * x / SIDE) as u8].into())
        .save(&confidence)
        .unwrap();
    let data = room.load(&with(on())).unwrap();
    assert_eq!(data.depth.as_ref().unwrap().views, 7);
    assert!(
        data.notes.iter().any(|note| note.contains("1 of 8 views have no depth")),
        "{:?}",
        data.notes
    );
    let view = data.train.iter().find(|view| view.name.contains(&stem)).unwrap();
    let map = view.source.load_depth().unwrap().unwrap();
    let levels: std::collections::BTreeSet<u8> = map.confidence.iter().copied().collect();
    assert_eq!(levels.into_iter().collect::<Vec<_>>(), [0, 127, 255]);
    image::GrayImage::new(SIDE, SIDE / 2).save(&confidence).unwrap();
    assert!(room.refusal(on()).0.contains("instead of the depth map's 48x48 px"));
}

#[test]
fn pictures_of_depth_and_other_sizes_are_refused() {
    let of_png = |picture: image::DynamicImage| {
        let room = Room::new();
        for path in room.arrays() {
            picture.save(path.with_extension("png")).unwrap();
            std::fs::remove_file(path.with_extension("npy")).unwrap();
            std::fs::remove_file(path.with_extension("exr")).unwrap();
        }
        room.refusal(on()).0
    };
    let message = of_png(image::GrayImage::new(SIDE, SIDE).into());
    assert!(message.contains("8 bits"), "{message}");
    let message = of_png(image::ImageBuffer::<image::Luma<u16>, _>::new(SIDE, SIDE / 2).into());
    assert!(message.contains("proportions"), "{message}");
    let room = Room::new();
    std::fs::write(&room.arrays()[0], b"\x93NUMPY\x01\x00").unwrap();
    assert!(room.refusal(on()).0.contains(".npy"));
    let empty = Room::new();
    std::fs::remove_dir_all(empty.path().join("depth")).unwrap();
    let error = empty.load(&with(on())).unwrap_err();
    assert!(error.to_string().contains("no training view has depth"), "{error}");
}

#[test]
fn depth_in_open_exr_and_with_a_mask_and_a_smaller_map_is_read() {
    let room = Room::new();
    let truth = stored(&room.arrays()[2]);
    for path in room.arrays() {
        std::fs::remove_file(path).unwrap();
    }
    let options = LoadOptions { mask_mode: MaskMode::Ignore, ..with(on()) };
    let data = room.load(&options).unwrap();
    let (worst, _) = error(&data, 2, |x, y| truth[(x, y)].0[0] / 1000.0);
    assert!(worst < 0.002, "{worst}");
    // A map of half the size: each of its pixels covers four of the photograph.
    let room = Room::new();
    for path in room.arrays() {
        let whole = stored(&path);
        let half =
            (0..SIDE * SIDE / 4).map(|i| whole[(2 * (i % (SIDE / 2)), 2 * (i / (SIDE / 2)))].0[0]);
        write_array(&path, (SIDE / 2, SIDE / 2), half);
    }
    let data = room.load(&with(on())).unwrap();
    let (worst, counted) = error(&data, 2, |x, y| truth[(x / 2 * 2, y / 2 * 2)].0[0] / 1000.0);
    assert!(worst < 0.002 && counted > 0.1, "{worst} {counted}");
}

#[test]
fn points_become_sparse_depth() {
    let room = Room::new();
    let points = Some(room.path().join("points3d.ply"));
    let data = room.load(&with(DepthOptions { points, ..on() })).unwrap();
    let found = data.depth.as_ref().unwrap();
    assert_eq!((found.source, found.views), (DepthOrigin::Points, 8));
    assert!(found.known > 0.005 && found.known < 0.4, "{found:?}");
    assert!(found.points > 0, "{found:?}");
    let cloud = |name: &str, change: &dyn Fn(DVec3) -> DVec3| {
        let path = room.path().join(name);
        let (points, _) = crate::points::read_points(&room.path().join("points3d.ply")).unwrap();
        let rows = points.positions.iter().map(|&point| {
            let DVec3 { x, y, z } = change(point);
            format!("{x} {y} {z}\n")
        });
        let header = format!(
            "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n\
             end_header\n",
            points.len()
        );
        std::fs::write(&path, header + &rows.collect::<String>()).unwrap();
        DepthOptions { points: Some(path), ..on() }
    };
    let refused = |options| match room.load(&with(options)).map(|data| data.depth).unwrap_err() {
        LoadError::Remedied { problem, remedy: LoadRemedy::Depth(remedy) } => (problem, remedy),
        other => panic!("{other}"),
    };
    // A cloud in other units, around the middle of the cameras, and one that no view shows.
    let (problem, remedy) = refused(cloud("scaled.ply", &|point| 1.5 * point));
    assert_eq!(remedy, DepthRemedy::Align, "{problem}");
    let (problem, remedy) = refused(cloud("away.ply", &|point| point + DVec3::splat(1e4)));
    assert_eq!(remedy, DepthRemedy::Align, "{problem}");
    assert!(problem.contains("none of the 8 checked views"), "{problem}");
    // Without other points the cloud seeds the scene, whether its depth is used or not, and is not compared with itself.
    let same = cloud("same.ply", &|point| point);
    std::fs::remove_file(room.path().join("points3d.ply")).unwrap();
    for split in ["train", "test"] {
        let list = room.path().join(format!("transforms_{split}.json"));
        let text = std::fs::read_to_string(&list).unwrap();
        let mut json: serde_json::Value = serde_json::from_str(&text).unwrap();
        json.as_object_mut().unwrap().remove("ply_file_path");
        std::fs::write(&list, json.to_string()).unwrap();
    }
    let seeded = room.load(&with(same.clone())).unwrap();
    assert_eq!(seeded.depth.as_ref().map(|found| found.points), Some(0));
    let off = room.load(&with(DepthOptions { choice: DepthChoice::Off, ..same })).unwrap();
    assert!(off.depth.is_none() && off.points.len() == seeded.points.len());
    assert!(off.points.len() > 100);
    let none = DepthOptions { points: Some("missing.ply".into()), ..on() };
    assert!(room.load(&with(none)).unwrap_err().to_string().contains("missing.ply"));
}

#[test]
fn built_in_scenes_have_the_depth_of_their_surface() {
    let path = Path::new("scene:spheres");
    let small = |depth| LoadOptions { resolution: Some(Resolution::Width(16)), ..with(depth) };
    let data = Dataset::load(path, &small(on())).unwrap();
    let found = data.depth.as_ref().unwrap();
    assert_eq!((found.source, found.views), (DepthOrigin::Surface, data.train.len()));
    let map = data.train[0].source.load_depth().unwrap().unwrap();
    assert_eq!(map.width, data.train[0].camera.width);
    let depth = data.train[0].source.depth.as_ref().unwrap();
    assert!(depth.pixel_bytes() >= 4 * 16 * 16 && depth.held_bytes() < 4 * 16 * 16);
    let auto = DepthOptions { choice: DepthChoice::Auto, ..on() };
    assert!(Dataset::load(path, &small(auto)).unwrap().depth.is_none());
}

#[test]
fn damaged_files_are_errors_and_never_panics() {
    let room = Room::new();
    let array = room.arrays()[0].clone();
    let (width, height) = (5, 4);
    let png = room.path().join("a.png");
    image::ImageBuffer::from_fn(width, height, |x, y| image::Luma([(700 * x + y) as u16]))
        .save(&png)
        .unwrap();
    let colmap = room.path().join("a.bin");
    let values: Vec<u8> = (0..width * height).flat_map(|i| (i as f32).to_le_bytes()).collect();
    std::fs::write(&colmap, [format!("{width}&{height}&1&").as_bytes(), &values].concat()).unwrap();
    let mut refused = 0;
    for (path, kind) in [
        (array.clone(), DepthKind::Npy),
        (array.with_extension("exr"), DepthKind::Exr),
        (png, DepthKind::Png),
        (colmap, DepthKind::Colmap),
    ] {
        let whole = std::fs::read(&path).unwrap();
        let read = |bytes: &[u8]| {
            std::fs::write(&path, bytes).unwrap();
            let source = SourceFile::existing(path.clone()).unwrap();
            // Headers of damaged files may be fine, but then the values must have their size.
            let header = raw::read_header(&source, kind);
            let values = raw::read(&source, kind, true);
            if let (Ok(header), Ok(values)) = (&header, &values) {
                assert_eq!((header.width, header.height), values.0.dimensions(), "{kind:?}");
            }
            usize::from(values.is_err())
        };
        assert_eq!(read(&whole), 0, "{kind:?}");
        for at in (0..whole.len().min(400)).chain([whole.len() - 1]) {
            refused += read(&whole[..at]);
            let mut flipped = whole.clone();
            flipped[at] ^= 1 << (at % 8);
            refused += read(&flipped);
        }
    }
    assert!(refused > 800, "{refused}");
}

#[test]
fn depth_of_polycam_is_found_beside_its_corrected_images() {
    let room = Room::new();
    let _ = std::fs::remove_file(room.path().join("scene.json"));
    let [images, depth] = ["corrected_images", "depth"].map(|name| {
        let folder = room.path().join("keyframes").join(name);
        std::fs::create_dir_all(&folder).unwrap();
        folder
    });
    let list = room.path().join("transforms_train.json");
    let mut json: serde_json::Value =
        serde_json::from_str(&std::fs::read_to_string(&list).unwrap()).unwrap();
    for (frame, array) in json["frames"].as_array_mut().unwrap().iter_mut().zip(room.arrays()) {
        let image = room.path().join(frame["file_path"].as_str().unwrap()).with_extension("png");
        let stem = array.file_stem().unwrap().to_str().unwrap().to_owned();
        std::fs::copy(image, images.join(format!("{stem}.png"))).unwrap();
        std::fs::copy(&array, depth.join(format!("{stem}.npy"))).unwrap();
        frame["file_path"] = format!("keyframes/corrected_images/{stem}.png").into();
        frame.as_object_mut().unwrap().remove("depth_file_path");
    }
    std::fs::write(&list, json.to_string()).unwrap();
    std::fs::remove_dir_all(room.path().join("depth")).unwrap();
    assert_eq!(room.load(&with(on())).unwrap().depth.unwrap().views, 8);
}

#[test]
fn notes_about_depth_in_an_archive_name_the_archive() {
    use std::io::Write;
    let room = Room::new();
    let _ = std::fs::remove_file(room.path().join("scene.json"));
    room.edit(|_, _, _| 4.0);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("my room.zip");
    let mut archive = zip::ZipWriter::new(std::fs::File::create(&path).unwrap());
    let mut folders = vec![room.path().to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in folder.read_dir().unwrap() {
            let entry = entry.unwrap().path();
            if entry.is_dir() {
                folders.push(entry);
                continue;
            }
            let name = entry.strip_prefix(room.path()).unwrap().to_str().unwrap();
            archive.start_file(name, zip::write::SimpleFileOptions::default()).unwrap();
            archive.write_all(&std::fs::read(&entry).unwrap()).unwrap();
        }
    }
    archive.finish().unwrap();
    let auto = DepthOptions { choice: DepthChoice::Auto, ..on() };
    let data = Dataset::load(&path, &with(auto)).unwrap();
    let left_out = data.notes.iter().find_map(|note| match note {
        Note::DepthLeftOut(error) => Some(error.to_string()),
        _ => None,
    });
    let left_out = left_out.unwrap();
    assert!(left_out.starts_with(path.to_str().unwrap()), "{left_out}");
}
