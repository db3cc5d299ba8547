//! Options that must not change a byte of the model: number of threads and size of the image cache.

use densify_policies::registry::policies;

use super::{frequent_edits, model, scratch, train};
use crate::photographs::{Photographs, SIZE};

const ITERATIONS: u32 = 60;

fn trained(scene: &Photographs, flags: &str) -> Vec<u8> {
    let (_root, run) = scratch();
    let flags = format!("--budget 330 --quiet {flags}");
    train(scene.path(), &run, ITERATIONS, &flags).ok();
    model(&run, ITERATIONS)
}

#[test]
fn models_do_not_depend_on_the_number_of_threads() {
    let scene = Photographs::colmap_text();
    let registered = policies().expect("the registry is sound");
    assert!(registered.len() >= 2);
    for entry in registered {
        let (policy, often) = (entry.name, frequent_edits(entry));
        let train_with =
            |flags: &str| trained(&scene, &format!("--policy {policy} {often} {flags}"));
        let first = train_with("--threads 1");
        for threads in ["--threads 1", "--threads 2", "--threads 5", ""] {
            assert!(train_with(threads) == first, "{policy}: {threads:?} changes the model");
        }
        assert!(train_with("--seed 1") != first, "{policy}: the seed changes nothing");
    }
}

#[test]
fn models_do_not_depend_on_the_image_cache() {
    let scene = Photographs::colmap_text();
    let two = 2 * 3 * SIZE.0 * SIZE.1 + 100;
    let small = trained(&scene, &format!("--image-cache {two}"));
    assert!(small == trained(&scene, "--image-cache 1GiB"));
    assert!(small == trained(&scene, "--image-cache 0"));
}
