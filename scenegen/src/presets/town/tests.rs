//! Tests of a town's views and of its growth with its size.

use glam::DVec2;

use super::*;
use crate::camera::Camera;
use crate::surface::{Surface, SurfaceHit};

/// A town's geometry with its training and test views.
fn town(size: u32, seed: u64) -> (Staging, Surface, [Vec<Camera>; 2]) {
    let staging = build(size, seed);
    let surface = Surface::new(&staging.model).expect("triangles");
    let rig = Rig { seed, ..staging.rig.clone() };
    let (train, test) = rig.cameras(&surface, &[]).expect("cameras");
    (staging, surface, [train, test])
}

/// The surface points that a view shows at the centres of 16 x 12 cells.
fn seen(surface: &Surface, camera: &Camera) -> Vec<Option<SurfaceHit>> {
    let cell = DVec2::new(f64::from(camera.width) / 16.0, f64::from(camera.height) / 12.0);
    let ray = |i: u32| {
        let at = (DVec2::new(f64::from(i % 16), f64::from(i / 16)) + 0.5) * cell;
        surface.cast(camera.centre, camera.direction(at), f64::INFINITY)
    };
    (0..16 * 12).map(ray).collect()
}

#[test]
fn views_are_outside_solids_and_mostly_show_surfaces() {
    for (size, seed) in [(1, 0), (2, 0), (2, 1), (3, 7)] {
        let (_, surface, views) = town(size, seed);
        for (i, camera) in views.iter().flatten().enumerate() {
            let seen = seen(&surface, camera);
            let met: Vec<&SurfaceHit> = seen.iter().flatten().collect();
            let name = format!("town:{size} with seed {seed}, view {i} at {}", camera.centre);
            assert!(met.len() * 10 > 6 * seen.len(), "{name}: {} of {}", met.len(), seen.len());
            let backs = met.iter().filter(|hit| !hit.front).count();
            assert_eq!(backs, 0, "{name} sees the back of a surface");
            let nearest = met.iter().map(|hit| hit.t).fold(f64::INFINITY, f64::min);
            assert!(nearest > 0.4, "{name}: {nearest} m");
            assert!((0.8..=FLIGHT + 1.0).contains(&camera.centre.y), "{name}");
        }
    }
}

#[test]
fn views_are_from_above_and_from_the_street() {
    let (staging, _, [train, test]) = town(2, 0);
    let [above, below] = [true, false].map(|is_above| {
        let count = |views: &[Camera]| {
            views.iter().filter(|c| (c.centre.y > 0.5 * FLIGHT) == is_above).count()
        };
        (count(&train), count(&test))
    });
    assert_eq!((above, below), ((64, 16), (32, 8)));
    // Street views are on a carriageway.
    let streets: Vec<[DVec3; 2]> = streets(2).collect();
    for camera in train.iter().chain(&test).filter(|c| c.centre.y < 0.5 * FLIGHT) {
        let off = |[a, b]: &[DVec3; 2]| {
            let (flat, along) = (camera.centre.with_y(0.0), *b - *a);
            let share = ((flat - *a).dot(along) / along.length_squared()).clamp(0.0, 1.0);
            flat.distance(*a + share * along)
        };
        let off = streets.iter().map(off).fold(f64::INFINITY, f64::min);
        assert!(off < 3.5, "{off} m from the middle of a street");
    }
    assert_eq!(staging.rig.train, 96);
}

#[test]
fn a_town_grows_with_its_size_and_is_determined_by_its_seed() {
    let sizes = [1, 2, 4].map(|size| build(size, 0));
    for (staging, blocks) in sizes.iter().zip([1, 4, 16]) {
        assert_eq!((staging.rig.train, staging.rig.test), (24 * blocks, 6 * blocks));
        let triangles = staging.model.triangles.len() as u32 / blocks;
        assert!((3000..16_000).contains(&triangles), "{triangles} triangles per block");
        let (lo, hi) = staging.model.bounds();
        let side = PITCH * f64::from(blocks).sqrt() + 2.0 * (HALF_STREET + MEADOW);
        assert!(((hi - lo).x - side).abs() < 1e-9 && lo.y.abs() < 1e-9, "{lo} to {hi}");
    }
    let bytes = |size, seed| {
        let model = build(size, seed).model;
        (format!("{:?}", model.positions), model.triangles, model.triangle_materials)
    };
    assert!(bytes(2, 5) == bytes(2, 5));
    assert!(bytes(2, 5) != bytes(2, 6));
}

#[test]
fn houses_are_closed() {
    // Every horizontal or upward ray from inside hits the house, and most hit the back of a wall.
    let (_, surface, _) = town(1, 0);
    for plot in 0..4 {
        let middle = dvec3(9.4 * (f64::from(plot) - 1.5), 1.5, 13.0);
        let mut backs = 0;
        for i in 0..60 {
            let turn = f64::from(i) * 2.4;
            let way = dvec3(turn.sin(), 0.04 * f64::from(i), turn.cos()).normalize();
            let hit = surface.cast(middle, way, f64::INFINITY).expect("a wall or a roof");
            assert!(hit.t < 15.0, "from {middle} along {way}: {hit:?}");
            backs += u32::from(!hit.front);
        }
        assert!(backs > 40, "{backs} of 60 from {middle}");
    }
}
