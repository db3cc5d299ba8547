//! Photographs whose cameras are not known: what the commands say, without an engine that finds them. Tests with
//! engines are in `src/tools/poses/tests.rs`, and `.ci/run` finds poses with pycolmap.

use std::path::PathBuf;

use super::{call, call_with_path, files, scratch, text};

/// A folder with four photographs.
fn photographs() -> (tempfile::TempDir, PathBuf) {
    let (root, _) = scratch();
    let folder = root.path().join("photos");
    std::fs::create_dir(&folder).unwrap();
    for number in 0..4 {
        image::RgbImage::new(8, 6).save(folder.join(format!("{number}.png"))).unwrap();
    }
    (root, folder)
}

#[test]
fn without_pycolmap_commands_say_what_to_install_and_write_nothing() {
    let (root, folder) = photographs();
    let before = files(root.path());
    let (photos, empty) = (text(&folder), text(root.path()));
    let words = ["no pycolmap", "pip install pycolmap"];
    call_with_path(&format!("train {photos}"), empty).refused("train", &words);
    let scene = root.path().join("scene");
    call_with_path(&format!("poses {photos} -o {}", text(&scene)), empty).refused("poses", &words);
    let python = root.path().join("no-python");
    let named = format!("poses {photos} -o {} --python {}", text(&scene), text(&python));
    call(&named).refused("--python", &["no-python", "pip install pycolmap"]);
    assert!(files(root.path()) == before && !scene.exists(), "something was written");
}

#[test]
fn other_commands_say_how_to_find_cameras_and_few_photographs_are_refused() {
    let (root, folder) = photographs();
    call(&format!("plan {}", text(&folder)))
        .refused("plan", &["is not a dataset", "`densify poses`"]);
    for number in 1..4 {
        std::fs::rename(
            folder.join(format!("{number}.png")),
            root.path().join(format!("{number}.heic")),
        )
        .unwrap();
    }
    std::fs::rename(root.path().join("1.heic"), folder.join("1.heic")).unwrap();
    let scene = root.path().join("scene");
    let poses = format!("poses {} -o {}", text(&folder), text(&scene));
    call(&poses).refused("few", &["has 1 photograph, but at least 3", "1.heic", "heif-convert"]);
    std::fs::create_dir(&scene).unwrap();
    std::fs::write(scene.join("mine.txt"), "").unwrap();
    call(&poses).refused("occupied", &["exists", "--overwrite"]);
}
