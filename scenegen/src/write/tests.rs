//! Tests that scenes are written completely or not at all.

use super::*;
use crate::{Options, PointOptions, Source};

fn small() -> Scene {
    let options = Options {
        size: Some((24, 20)),
        train: Some(4),
        test: Some(2),
        grid: 1,
        points: PointOptions { count: 50, ..PointOptions::default() },
        ..Options::default()
    };
    Scene::prepare(&Source::Preset("spheres".into()), &options).expect("preset")
}

fn names(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).expect("folder");
    let mut names: Vec<String> =
        entries.map(|e| e.expect("entry").file_name().to_string_lossy().into_owned()).collect();
    names.sort();
    names
}

#[test]
fn everything_is_written_and_nothing_else_stays() {
    let scene = small();
    let root = tempfile::tempdir().expect("folder");
    let target = root.path().join("deep").join("scene");
    let mut seen = Vec::new();
    let written = write(&scene, &target, false, |view| seen.push(view)).expect("write");
    assert_eq!((written.views, seen), (6, vec![0, 1, 2, 3, 4, 5]));
    assert_eq!(names(&root.path().join("deep")), ["scene"]);
    assert_eq!(
        names(&target),
        [
            "depth",
            "images",
            "mesh.ply",
            "normals",
            "points3d.ply",
            "scene.json",
            "sparse",
            "transforms_test.json",
            "transforms_train.json"
        ]
    );
    for kind in ["images", "depth", "normals"] {
        assert_eq!(names(&target.join(kind).join("train")).len(), 4, "{kind}");
        assert_eq!(names(&target.join(kind).join("test")).len(), 2, "{kind}");
    }
    // Depth comes back bit for bit.
    let frame = scene.render(4);
    let path = target.join("depth/test/r_000.exr");
    let image = ::exr::prelude::read_first_flat_layer_from_file(&path).expect("EXR");
    let channel = &image.layer_data.channel_data.list[0];
    assert_eq!(channel.name.to_string(), "Z");
    let values: Vec<f32> = channel.sample_data.values_as_f32().collect();
    assert_eq!(values, frame.depth);
    // So do colour and alpha.
    let png = image::open(target.join("images/test/r_000.png")).expect("PNG").into_rgba8();
    assert_eq!(png.into_raw(), frame.rgba);
    // The same scene again makes the same files.
    let again = root.path().join("again");
    write(&small(), &again, false, |_| ()).expect("write");
    for name in
        ["scene.json", "points3d.ply", "mesh.ply", "sparse/0/images.txt", "images/train/r_002.png"]
    {
        let read = |folder: &Path| fs::read(folder.join(name)).expect(name);
        assert!(read(&target) == read(&again), "{name}");
    }
}

#[test]
fn existing_files_stay_unless_they_are_a_scene_to_replace() {
    let scene = small();
    let root = tempfile::tempdir().expect("folder");
    let target = root.path().join("scene");
    fs::create_dir(&target).expect("folder");
    // An empty folder may be used.
    write(&scene, &target, false, |_| ()).expect("write");
    assert!(matches!(write(&scene, &target, false, |_| ()), Err(Error::Option { .. })));
    fs::write(target.join("old"), "old").expect("write");
    write(&scene, &target, true, |_| ()).expect("write");
    assert!(!target.join("old").exists() && target.join("scene.json").exists());
    // A folder of something else is never touched.
    let other = root.path().join("other");
    fs::create_dir(&other).expect("folder");
    fs::write(other.join("thesis.txt"), "words").expect("write");
    for overwrite in [false, true] {
        assert!(matches!(write(&scene, &other, overwrite, |_| ()), Err(Error::Option { .. })));
    }
    assert_eq!(names(&other), ["thesis.txt"]);
    assert_eq!(names(root.path()), ["other", "scene"]);
}
