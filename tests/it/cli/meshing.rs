//! `densify mesh`, and `densify eval` of a mesh: files that are read back and scored, and refused calls.

use std::path::Path;

use densify::data::meshes;

use super::{call, files, read, scratch, text, train};

/// A small room, whose surface is known.
fn write_room(folder: &Path) {
    let small = "--size 48 --train 10 --test 2 --points 2000 --samples 1";
    call(&format!("scenegen --preset room -o {} {small}", text(folder))).ok();
}

#[test]
fn meshes_of_all_formats_are_scored_alike() {
    let (root, run) = scratch();
    let scene = root.path().join("room");
    write_room(&scene);
    train(&scene, &run, 100, "--budget 2k --eval --quiet").ok();
    let file = |name: &str| root.path().join(name);
    let mesh = |name: &str, flags: &str| {
        call(&format!("mesh {} -o {} {flags}", text(&run), text(&file(name))))
    };
    let stdout = mesh("a.ply", "").ok().stdout;
    for word in ["of the scene's diagonal", "vertices and", "a.ply"] {
        assert!(stdout.contains(word), "{word} is not in {stdout}");
    }
    let ply = meshes::read(&file("a.ply")).expect("a mesh");
    assert!(ply.triangles.len() > 1000, "{}", ply.triangles.len());
    let score = |name: &str| {
        call(&format!("eval {} --scene {}", text(&file(name)), text(&scene))).ok().stdout
    };
    let scores = score("a.ply");
    assert!(scores.contains("F-score at 1 %") && scores.contains("Chamfer"), "{scores}");
    // The percentages of a table.
    let numbers = |table: &str| -> Vec<f64> {
        let lines = table.lines().filter_map(|line| line.strip_suffix(" %"));
        lines.filter_map(|line| line.split_whitespace().last()?.parse().ok()).collect()
    };
    assert_eq!(numbers(&scores).len(), 9, "{scores}");
    for name in ["a.glb", "a.obj"] {
        mesh(name, "").ok();
        for (found, expected) in numbers(&score(name)).into_iter().zip(numbers(&scores)) {
            // OBJ has decimal digits, so that single samples of 20,000 may lie beyond a limit.
            assert!((found - expected).abs() < 0.02, "{name}: {found}, {expected}");
        }
        assert_eq!(meshes::read(&file(name)).expect(name).triangles.len(), ply.triangles.len());
    }
    assert!(stdout.contains("depth    median depth"), "{stdout}");
    // Where depth was trained on, the expected depth of a pixel is the better one.
    let with_depth = root.path().join("with-depth");
    train(&scene, &with_depth, 20, "--budget 2k --depth on --quiet").ok();
    let words =
        |flags: &str| format!("mesh {} -o {} {flags}", text(&with_depth), text(&file("f.ply")));
    let stdout = call(&words("")).ok().stdout;
    assert!(stdout.contains("depth    expected depth"), "{stdout}");
    let expected = read(&file("f.ply"));
    call(&words("--depth-kind median --overwrite")).ok();
    assert!(read(&file("f.ply")) != expected);
    // Neither threads nor passes change the file; a model file gives the same mesh as its run.
    // The least memory that suffices depends on the program's own size.
    let outcomes = (32..512).step_by(8).map(|mebibytes| {
        mesh("e.ply", &format!("--voxel 0.01 --threads 1 --memory {mebibytes}MiB"))
    });
    let stdout =
        outcomes.into_iter().find(|outcome| outcome.code == Some(0)).expect("enough").stdout;
    assert!(stdout.contains(" passes, within the memory"), "{stdout}");
    mesh("d.ply", "--voxel 0.01 --memory 2GiB").ok();
    assert!(read(&file("e.ply")) == read(&file("d.ply")));
    mesh("b.ply", "--threads 1").ok();
    let model = run.join("point_cloud/iteration_100/point_cloud.ply");
    let scene_flag = format!("--scene {} --eval", text(&scene));
    call(&format!("mesh {} -o {} {scene_flag}", text(&model), text(&file("c.ply")))).ok();
    assert!(read(&file("b.ply")) == read(&file("a.ply")), "{stdout}");
    assert!(read(&file("c.ply")) == read(&file("a.ply")));
    // Limits apply to meshes, too.
    let limit = |key: &str| {
        call(&format!("eval {} --scene {} --fail-below {key}", text(&file("a.ply")), text(&scene)))
    };
    limit("f_score_one_percent=0.01").ok();
    let outcome = limit("f_score_one_percent=0.999");
    assert_eq!(outcome.code, Some(4), "{outcome:?}");
    limit("psnr=3").refused("another metric", &["--fail-below", "psnr", "f_score_one_percent"]);
}

#[test]
fn bad_calls_are_refused_and_write_nothing() {
    let (root, run) = scratch();
    let scene = root.path().join("room");
    write_room(&scene);
    train(&scene, &run, 4, "--budget 2k --quiet").ok();
    let mesh = |name: &str, flags: &str| {
        call(&format!("mesh {} -o {} {flags}", text(&run), text(&root.path().join(name))))
    };
    let before = files(root.path());
    for (name, flags, words) in [
        ("a.stl", "", &["-o:", ".ply, .glb or .obj"][..]),
        ("a.ply", "--voxel 0", &["--voxel", "above 0"]),
        ("a.ply", "--voxel 0.0000001", &["voxels of", "larger --voxel"]),
        ("a.ply", "--voxel 0.002 --memory 64MiB", &["memory is too small", "--memory", "--voxel"]),
        ("a.ply", "--memory 1MiB", &["--memory", "too little"]),
        ("a.ply", "--box 0,0,0,1", &["--box", "smallest"]),
        ("a.ply", "--box -90,-90,-90,90,90,90 --voxel 1e-7", &["too small for a box", "--voxel"]),
        ("a.ply", "--min-component 1.5", &["--min-component", "from 0 to 1"]),
        ("a.ply", "--box 90,90,90,91,91,91", &["no view shows a surface", "box"]),
        ("a.ply", "--depth-kind mean", &["expected or median"]),
        ("a.ply", "--backend gpu", &["--backend", "processor"]),
        ("a.ply", "--resolution 2", &["--resolution"]),
    ] {
        let outcome = mesh(name, flags);
        assert_eq!(outcome.code, Some(2), "{flags}: {outcome:?}");
        for word in words {
            assert!(outcome.stderr.contains(word), "{flags}: {word} is not in {}", outcome.stderr);
        }
        assert_eq!(files(root.path()), before, "{flags}");
    }
    // An existing file stays.
    std::fs::write(root.path().join("b.ply"), "mine").expect("write");
    mesh("b.ply", "").refused("an existing file", &["b.ply exists", "--overwrite"]);
    assert_eq!(read(&root.path().join("b.ply")), b"mine");
    // A mesh can be scored only where the surface is known.
    let obj = root.path().join("a.obj");
    std::fs::write(&obj, "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n").expect("write");
    call(&format!("eval {}", text(&obj))).refused("no scene", &["a.obj is a mesh", "--scene DIR"]);
    for flags in [
        "--iteration 4",
        "--split train",
        "--lpips weights.safetensors",
        "--fit-exposure",
        "--near 0.1",
        "--antialias",
        "--backend cpu",
        "--gpu any",
    ] {
        let outcome = call(&format!("eval {} --scene {} {flags}", text(&obj), text(&scene)));
        let option = flags.split(' ').next().unwrap_or(flags);
        outcome.refused(flags, &[option, "for models", "is a mesh"]);
    }
    std::fs::remove_file(scene.join("scene.json")).expect("an existing file");
    let outcome = call(&format!("eval {} --scene {}", text(&obj), text(&scene)));
    outcome.refused("an unknown surface", &["--scene", "not known"]);
}
