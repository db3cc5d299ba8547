//! `densify scenegen` and built-in scenes: what is written is what is trained on.

use std::path::Path;

use densify::dataset::{Dataset, LoadOptions};

use super::{densify, files, scratch, text, train};

fn load(path: &Path) -> Dataset {
    Dataset::load(path, &LoadOptions::default()).unwrap_or_else(|e| panic!("{e}"))
}

/// Whether two datasets pose the same cameras and show the same images.
fn assert_same(a: &Dataset, b: &Dataset, what: &str) {
    assert_eq!(a.train.len(), b.train.len(), "{what}");
    for (x, y) in a.train.iter().zip(&b.train) {
        let apart = x.camera.centre().distance(y.camera.centre());
        let turned = x.camera.forward().distance(y.camera.forward());
        assert!(apart < 1e-9 && turned < 1e-9, "{what}: {} by {apart}, {turned}", x.name);
        assert!((x.camera.fx - y.camera.fx).abs() < 1e-9, "{what}");
        let [x, y] = [x, y].map(|view| view.source.load().expect("an image"));
        assert!(x == y, "{what}");
    }
}

#[test]
fn written_scenes_load_as_the_built_in_ones_through_both_formats() {
    let (_root, folder) = scratch();
    densify(&["scenegen", "--preset", "spheres", "-o", text(&folder)]).ok();
    let built_in = load(Path::new("scene:spheres"));
    let written = load(&folder);
    assert_same(&built_in, &written, "transforms");
    assert_eq!((written.train.len(), written.test.len()), (30, 10));
    assert_eq!(written.points.len(), built_in.points.len());
    for name in ["transforms_train.json", "transforms_test.json"] {
        std::fs::remove_file(folder.join(name)).expect("it is there");
    }
    let colmap = load(&folder);
    assert_eq!((colmap.train.len(), colmap.points.len()), (40, built_in.points.len()));
    // Its unit is that of all forty cameras.
    let find = |name: &str| colmap.train.iter().find(|v| v.name.ends_with(name)).expect(name);
    let world = |set: &Dataset, view: &densify::dataset::View| {
        set.normalisation.denormalise_camera(&view.camera).centre()
    };
    for view in &written.train {
        let name = format!("{}.png", view.name.rsplit('/').next().expect("a name"));
        let other = find(&format!("train/{name}"));
        let apart = world(&written, view).distance(world(&colmap, other));
        assert!(apart < 1e-9, "{}: {apart}", view.name);
    }
}

#[test]
fn built_in_scenes_are_trained_on_and_measured_by_name() {
    let (_root, run) = scratch();
    let said = train(Path::new("scene:spheres"), &run, 4, "--budget 6k").ok();
    assert!(said.stdout.contains("30 views"), "{}", said.stdout);
    let said = densify(&["eval", text(&run)]).ok();
    assert!(said.stdout.contains("PSNR"), "{}", said.stdout);
}

#[test]
fn bad_input_is_refused_and_leaves_nothing() {
    let (root, out) = scratch();
    let broken = root.path().join("broken.glb");
    std::fs::write(&broken, b"glTF\x02\0\0\0\xff\xff\xff\xff").expect("write");
    let (broken, out) = (text(&broken), text(&out));
    let cases: [(&[&str], &[&str]); 8] = [
        (&["scenegen", broken, "-o", out], &["broken.glb", "GLB header"]),
        (&["scenegen", "nothing.obj", "-o", out], &["nothing.obj"]),
        (&["scenegen", "mesh.fbx", "-o", out], &["mesh.fbx", ".obj"]),
        (&["scenegen", "--preset", "nonsense", "-o", out], &["nonsense", "spheres"]),
        (&["scenegen", "--preset", "thin", "-o", out, "--size", "99999"], &["--width", "99999"]),
        (&["scenegen", "--preset", "thin", "-o", out, "--fov", "180"], &["--fov"]),
        (&["scenegen", "--preset", "thin", "-o", out, "--rig", "file"], &["--rig"]),
        (&["train", "scene:nonsense"], &["nonsense", "spheres"]),
    ];
    for (arguments, words) in cases {
        densify(arguments).refused(&format!("{arguments:?}"), words);
    }
    let left = files(root.path());
    assert_eq!(left.keys().collect::<Vec<_>>(), ["broken.glb"]);
    // Neither is a folder of something else touched.
    densify(&["scenegen", "--preset", "thin", "-o", text(root.path())])
        .refused("a full folder", &["--output", "not empty"]);
}

#[test]
fn presets_are_listed() {
    let said = densify(&["scenegen", "--list"]).ok().stdout;
    for name in ["spheres", "thin", "chirp", "table", "layers", "room", "glossy", "cornell"] {
        assert!(said.lines().any(|line| line.starts_with(name)), "{name} is not in {said}");
    }
}
