//! Tests that memory does not depend on the number of views, which stream to disk. A separate program, as it
//! measures the peak memory of the process.
#![allow(clippy::print_stderr, reason = "tests say why they skip")]

mod process;

use densify_scenegen::{Options, PointOptions, Scene, Source, write};
use process::status;

const SIDE: u32 = 256;
/// Memory of a pixel: colour, depth, normal and triangle.
const PIXEL_BYTES: u64 = 4 + 4 + 12 + 4;

fn write_views(train: u32) {
    let options = Options {
        size: Some((SIDE, SIDE)),
        train: Some(train),
        test: Some(1),
        grid: 1,
        points: PointOptions { count: 100, ..PointOptions::default() },
        ..Options::default()
    };
    let folder = tempfile::tempdir().expect("a folder");
    let scene = Scene::prepare(&Source::Preset("spheres".into()), &options).expect("a scene");
    let written = write(&scene, &folder.path().join("scene"), false, |_| ()).expect("written");
    assert_eq!(written.views, train as usize + 1);
}

#[test]
fn peak_memory_does_not_depend_on_the_number_of_views() {
    write_views(3);
    let Some(few) = status("VmHWM:") else {
        eprintln!("skipped: this system does not report the peak memory of a process");
        return;
    };
    write_views(60);
    let many = status("VmHWM:").expect("a peak");
    let image = u64::from(SIDE * SIDE) * PIXEL_BYTES;
    // Holding the views would take the memory of sixty images; four allow for variations of the allocator.
    assert!(
        many - few < 4 * image,
        "{} more images at the peak",
        (many - few) as f64 / image as f64
    );
}
