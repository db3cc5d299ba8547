//! The cache of rendered built-in scenes: scenes are rendered once, and results do not depend on the cache.

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
    let entries = std::fs::read_dir(cache.join("densify/scenes")).into_iter().flatten();
    entries.map(|entry| entry.expect("an entry").path()).collect()
}

#[test]
fn a_built_in_scene_is_rendered_once() {
    let (root, _) = scratch();
    let cache = root.path().join("cache");
    let run = |name: &str| root.path().join(name);
    let expected = train(&cache, &run("uncached"), &["--no-cache"]);
    assert!(entries(&cache).is_empty());
    assert!(train(&cache, &run("first"), &[]) == expected);
    let cached = entries(&cache);
    assert_eq!(cached.len(), 1, "{cached:?}");
    // A rewritten entry would be a new file with another inode.
    let inode = || std::fs::metadata(&cached[0]).expect("an entry").ino();
    let before = inode();
    assert!(train(&cache, &run("second"), &[]) == expected);
    assert_eq!(inode(), before, "the scene was rendered again");
    // A damaged entry is replaced.
    let bytes = std::fs::read(&cached[0]).expect("an entry");
    std::fs::write(&cached[0], &bytes[..bytes.len() / 2]).expect("a damaged entry");
    assert!(train(&cache, &run("damaged"), &[]) == expected);
    assert!(std::fs::read(&cached[0]).expect("an entry") == bytes);
}
