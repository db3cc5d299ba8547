//! Built-in scenes are rendered once, and the cache changes nothing but the time.

use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use assert_cmd::Command;

use super::{model, scratch, text};

fn train(cache: &Path, run: &Path, flags: &[&str]) -> Vec<u8> {
    let mut command = Command::new(env!("CARGO_BIN_EXE_densify"));
    command.env("XDG_CACHE_HOME", cache);
    command.args(["train", "scene:spheres", "-o", text(run), "--budget", "2k", "-r", "4"]);
    command.args(["--iterations", "5", "--sh-degree", "auto", "--backend", "cpu"]).args(flags);
    command.assert().success();
    model(run, 5)
}

fn entries(cache: &Path) -> Vec<PathBuf> {
    let found = std::fs::read_dir(cache.join("densify/scenes")).into_iter().flatten();
    found.map(|entry| entry.expect("an entry").path()).collect()
}

#[test]
fn a_built_in_scene_is_rendered_once() {
    let (root, _) = scratch();
    let cache = root.path().join("cache");
    let run = |name: &str| root.path().join(name);
    let expected = train(&cache, &run("anew"), &["--no-cache"]);
    assert!(entries(&cache).is_empty());
    assert!(train(&cache, &run("first"), &[]) == expected);
    let kept = entries(&cache);
    assert_eq!(kept.len(), 1, "{kept:?}");
    // An entry that is made anew is another file.
    let number = || std::fs::metadata(&kept[0]).expect("an entry").ino();
    let before = number();
    assert!(train(&cache, &run("second"), &[]) == expected);
    assert_eq!(number(), before, "it was rendered again");
    // A damaged entry is made anew.
    let bytes = std::fs::read(&kept[0]).expect("an entry");
    std::fs::write(&kept[0], &bytes[..bytes.len() / 2]).expect("a damaged entry");
    assert!(train(&cache, &run("damaged"), &[]) == expected);
    assert!(std::fs::read(&kept[0]).expect("an entry") == bytes);
}
