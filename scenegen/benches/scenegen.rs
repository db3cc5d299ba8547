//! Compares the speed of this crate's primary rays with that of obvhs's own traversals of the same rays, and measures
//! build times, for 10,000 to 2 million triangles.
//!
//! The mesh is a bumpy sphere that fills 512 x 512 px; everything runs on one thread. Run with
//! `cargo bench -p densify-scenegen`; a number limits the triangles, as in `-- 600000`.
#![allow(missing_docs, clippy::print_stdout, reason = "a program that prints its measurements")]

use std::hint::black_box;
use std::time::{Duration, Instant};

use densify_scenegen::mesh::Model;
use densify_scenegen::{Camera, Surface};
use glam::{DVec2, DVec3, Vec3A};
use obvhs::BvhBuildParams;
use obvhs::bvh2::builder::build_bvh2_from_tris;
use obvhs::cwbvh::builder::build_cwbvh_from_tris;
use obvhs::ray::{Ray, RayHit};
use obvhs::triangle::Triangle;

const SIZE: u32 = 512;

/// A bumpy sphere of about `count` triangles.
fn mesh(count: usize) -> Model {
    let rings = ((count / 4) as f64).sqrt().ceil() as u32;
    let sectors = 2 * rings;
    let mut positions = Vec::new();
    for i in 0..=rings {
        for j in 0..=sectors {
            let (a, b) = (f64::from(i) / f64::from(rings), f64::from(j) / f64::from(sectors));
            let (polar, turn) = (a * std::f64::consts::PI, b * std::f64::consts::TAU);
            let radius = 1.0 + 0.05 * (17.0 * polar).sin() * (23.0 * turn).sin();
            let flat = radius * polar.sin();
            positions.push(DVec3::new(flat * turn.cos(), radius * polar.cos(), flat * turn.sin()));
        }
    }
    let mut triangles = Vec::new();
    for i in 0..rings {
        for j in 0..sectors {
            let at = i * (sectors + 1) + j;
            let below = at + sectors + 1;
            triangles.extend([[at, at + 1, below], [at + 1, below + 1, below]]);
        }
    }
    let mut model = Model::default();
    model.add(&positions, &[], &[], &triangles, 0);
    model
}

/// The highest speed of five runs over all rays, in millions of rays per second.
fn speed<T>(rays: &[T], cast: impl Fn(&T)) -> f64 {
    let best = (0..5)
        .map(|_| {
            let start = Instant::now();
            rays.iter().for_each(&cast);
            start.elapsed()
        })
        .min()
        .unwrap_or(Duration::MAX);
    rays.len() as f64 / best.as_secs_f64() / 1e6
}

fn main() {
    let limit = std::env::args().find_map(|word| word.parse::<usize>().ok()).unwrap_or(usize::MAX);
    let eye = DVec3::new(0.3, 1.1, 2.4);
    let camera = Camera::looking(eye, DVec3::ZERO, DVec3::Y, 0.9, (SIZE, SIZE));
    let directions: Vec<DVec3> = (0..SIZE * SIZE)
        .map(|i| camera.direction(DVec2::new(f64::from(i % SIZE) + 0.5, f64::from(i / SIZE) + 0.5)))
        .collect();
    println!("triangles  ours Mrays/s  CWBVH  BVH2  ours/fastest  ours build  CWBVH build");
    for count in [10_000, 100_000, 500_000, 2_000_000] {
        if count > limit {
            break;
        }
        let model = mesh(count);
        let start = Instant::now();
        let surface = Surface::new(&model).expect("triangles");
        let build_time = start.elapsed();
        let corner = |i: u32| Vec3A::from(model.positions[i as usize].as_vec3());
        let triangles: Vec<Triangle> = model
            .triangles
            .iter()
            .map(|&[a, b, c]| Triangle { v0: corner(a), v1: corner(b), v2: corner(c) })
            .collect();
        let rays: Vec<Ray> = directions
            .iter()
            .map(|d| Ray::new_inf(Vec3A::from(eye.as_vec3()), Vec3A::from(d.normalize().as_vec3())))
            .collect();
        let start = Instant::now();
        let (params, mut time) = (BvhBuildParams::medium_build, Duration::default());
        let wide = build_cwbvh_from_tris(&triangles, params(), &mut time);
        let wide_build_time = start.elapsed();
        let binary = build_bvh2_from_tris(&triangles, params(), &mut time);
        let in_order = |order: &[u32]| -> Vec<Triangle> {
            order.iter().map(|&i| triangles[i as usize]).collect()
        };
        let (wide_order, binary_order) =
            (in_order(&wide.primitive_indices), in_order(&binary.primitive_indices));

        let ours = speed(&directions, |direction| {
            black_box(surface.cast(eye, *direction, f64::INFINITY));
        });
        let cwbvh = speed(&rays, |ray| {
            let mut hit = RayHit::none();
            wide.ray_traverse(*ray, &mut hit, |ray, id| wide_order[id].intersect(ray));
            black_box(hit);
        });
        let bvh2 = speed(&rays, |ray| {
            let mut hit = RayHit::none();
            binary.ray_traverse(*ray, &mut hit, |ray, id| binary_order[id].intersect(ray));
            black_box(hit);
        });
        println!(
            "{:9}  {ours:12.2}  {cwbvh:5.2}  {bvh2:4.2}  {:11.0}%  {:8.2} s  {:9.2} s",
            model.triangles.len(),
            100.0 * ours / cwbvh.max(bvh2),
            build_time.as_secs_f64(),
            wide_build_time.as_secs_f64(),
        );
    }
}
