//! Tests that files agree with their scene, and that damaged files are refused.

use std::fs;

use super::*;
use crate::{Options, Source, Split, write};

fn scene(name: &str) -> Scene {
    let options = Options {
        size: Some((40, 32)),
        train: Some(2),
        test: Some(1),
        grid: 1,
        ..Options::default()
    };
    Scene::prepare(&Source::Preset(name.into()), &options).expect("preset")
}

#[test]
fn folders_agree_with_their_scene() {
    let root = tempfile::tempdir().expect("folder");
    let target = root.path().join("thin");
    let scene = scene("thin");
    write(&scene, &target, false, |_| ()).expect("write");
    let views = scene.views.clone();
    let frame = scene.render(2);
    let in_memory = GroundTruth::of_scene(scene);
    let in_folder = GroundTruth::open(&target).expect("read").expect("a scene");
    let corners = |truth: &GroundTruth| truth.surface().triangles().concat();
    let (a, b) = (corners(&in_memory), corners(&in_folder));
    assert_eq!(a.len(), b.len());
    assert!(a.iter().zip(&b).all(|(a, b)| a.distance(*b) < 1e-6), "another mesh");
    assert!(in_memory.has_thin() && in_folder.has_thin());
    let test = views.iter().find(|view| view.split == Split::Test).expect("a test view");
    let g_buffer = in_memory.g_buffer(&test.name, &test.camera).expect("traced");
    assert!(g_buffer.depth == frame.depth && g_buffer.normals == frame.normals);
    for name in ["test/r_000.png", "images/test/r_000.png", "./images/test/r_000"] {
        assert!(in_folder.g_buffer(name, &test.camera).expect("read") == g_buffer, "{name}");
    }
    // The files are read instead of tracing the mesh.
    let (from, to) = (target.join("depth/train/r_000.exr"), target.join("depth/test/r_000.exr"));
    fs::copy(from, to).expect("copy");
    let other = in_folder.g_buffer(&test.name, &test.camera).expect("read");
    assert!(other.depth != g_buffer.depth && other.normals == g_buffer.normals);
    // Without a file, or for a different size, the mesh is traced.
    let close = |a: &GBuffer, b: &GBuffer| {
        let apart = a.depth.iter().zip(&b.depth).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(apart < 1e-4, "{apart}");
    };
    close(&in_folder.g_buffer("nothing.png", &test.camera).expect("traced"), &g_buffer);
    let half = Camera { width: 20, height: 16, ..test.camera };
    close(
        &in_folder.g_buffer(&test.name, &half).expect("traced"),
        &in_memory.g_buffer("", &half).expect("traced"),
    );
    assert!(GroundTruth::open(root.path()).expect("no scene").is_none());
    // Files of other programs with these names are ignored.
    fs::write(root.path().join("mesh.ply"), "ply").expect("write");
    for record in ["{\"generator\": \"other\"}", "[1, 2]", "{"] {
        fs::write(root.path().join("scene.json"), record).expect("write");
        assert!(GroundTruth::open(root.path()).expect("no scene").is_none(), "{record}");
    }
}

#[test]
fn wires_have_their_true_thickness() {
    let truth = GroundTruth::of_scene(scene("thin"));
    // The first upright wire, radius 6 mm at x = −1.05, from the front; then the wall beside it.
    let from = DVec3::new(-1.05, 0.7, 2.0);
    let depth = truth.surface().cast(from, DVec3::NEG_Z, 10.0).expect("a wire").t;
    let thickness = truth.thickness(from, DVec3::NEG_Z, depth).expect("thin");
    assert!((0.0115..=0.012).contains(&thickness), "{thickness}");
    let beside = DVec3::new(-0.9, 0.7, 2.0);
    assert!(truth.thickness(beside, DVec3::NEG_Z, 2.6).is_none());
    // At the end of a wire of radius 12 mm, the thickness is the diameter and not the length.
    let above = DVec3::new(-0.75, 3.0, 0.003);
    let depth = truth.surface().cast(above, DVec3::NEG_Y, 10.0).expect("an end").t;
    let thickness = truth.thickness(above, DVec3::NEG_Y, depth).expect("thin");
    assert!((0.02..=0.025).contains(&thickness), "{thickness}");
    // At another depth, the wire is not what the ray hits first.
    assert!(truth.thickness(from, DVec3::NEG_Z, depth + 0.1).is_none());
}

#[test]
fn damaged_files_are_refused_without_panics() {
    let root = tempfile::tempdir().expect("folder");
    let target = root.path().join("scene");
    let scene = scene("spheres");
    write(&scene, &target, false, |_| ()).expect("write");
    let camera = scene.views[0].camera;
    let mesh = target.join("mesh.ply");
    let whole = fs::read(&mesh).expect("mesh");
    let header = whole.windows(11).position(|w| w == b"end_header\n").expect("an end") + 11;
    let refused = |bytes: &[u8], case: &str| {
        fs::write(&mesh, bytes).expect("write");
        let error = GroundTruth::open(&target).err().unwrap_or_else(|| panic!("{case}: accepted"));
        assert!(error.to_string().contains("mesh.ply"), "{case}: {error}");
    };
    for length in [0, 3, 40, header - 1, header, header + 1, whole.len() - 1] {
        refused(&whole[..length], &format!("{length} bytes"));
    }
    let edited = |at: usize, with: &[u8]| {
        let mut bytes = whole.clone();
        bytes[at..at + with.len()].copy_from_slice(with);
        bytes
    };
    refused(&edited(header, &f64::NAN.to_le_bytes()), "NaN");
    refused(&edited(whole.len() - 5, &u32::MAX.to_le_bytes()), "an index");
    let huge = String::from_utf8_lossy(&whole[..header]).replace("vertex ", "vertex 99999999999");
    refused(huge.as_bytes(), "a count");
    fs::write(&mesh, &whole).expect("write");

    let truth = GroundTruth::open(&target).expect("whole again").expect("a scene");
    let file = target.join("normals/train/r_000.exr");
    let whole = fs::read(&file).expect("normals");
    for length in [0, 7, 100, whole.len() / 2, whole.len() - 1] {
        fs::write(&file, &whole[..length]).expect("write");
        let error = truth.g_buffer("train/r_000.png", &camera).err();
        let message = error.unwrap_or_else(|| panic!("{length} bytes accepted")).to_string();
        assert!(message.contains("r_000.exr"), "{message}");
    }
    // A wrong byte gives wrong values or an error, but never a panic.
    for at in 0..whole.len().min(600) {
        for flip in [0x01, 0x80, 0xff] {
            let mut bytes = whole.clone();
            bytes[at] ^= flip;
            fs::write(&file, &bytes).expect("write");
            let _ = truth.g_buffer("train/r_000.png", &camera);
        }
    }
}
