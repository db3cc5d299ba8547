//! Tests that building the ray-tracing tree needs little more memory than the tree itself. A separate program, as it
//! measures the peak memory of the process.
#![allow(clippy::print_stderr, reason = "tests say why they skip")]

mod process;

use densify_scenegen::Surface;
use densify_scenegen::mesh::Model;
use glam::DVec3;
use process::status;

/// Allowed memory of obvhs's builder for one part: 65,536 triangles with 300 bytes each.
const PART_BYTES: u64 = 20 << 20;
/// Allowed memory per triangle: its index while parts are split, and candidates of the last optimisation.
const TRIANGLE_BYTES: u64 = 4 + 8;

/// A wavy sheet of `2 side²` triangles.
fn sheet(side: u32) -> Model {
    let corner = |k: u32| {
        let (x, y) = (f64::from(k % (side + 1)), f64::from(k / (side + 1)));
        DVec3::new(x, y, (0.1 * x).sin() * (0.07 * y).cos())
    };
    let corners: Vec<DVec3> = (0..(side + 1) * (side + 1)).map(corner).collect();
    let mut triangles = Vec::new();
    for cell in 0..side * side {
        let at = cell / side * (side + 1) + cell % side;
        let above = at + side + 1;
        triangles.extend([[at, at + 1, above], [at + 1, above + 1, above]]);
    }
    let mut model = Model::default();
    model.add(&corners, &[], &[], &triangles, 0);
    model
}

#[test]
fn building_takes_little_more_than_the_tree() {
    let model = sheet(600);
    let Some(before) = status("VmRSS:") else {
        eprintln!("skipped: this system does not report the memory of a process");
        return;
    };
    let surface = Surface::new(&model).expect("triangles");
    let peak = status("VmHWM:").expect("a peak");
    let allowed =
        surface.bytes() as u64 + model.triangles.len() as u64 * TRIANGLE_BYTES + PART_BYTES;
    let taken = peak - before;
    assert!(taken < allowed, "{taken} bytes taken, {allowed} allowed");
    assert!(taken > surface.bytes() as u64 / 2, "{taken} bytes: the peak was reached before");
}
