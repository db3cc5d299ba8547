//! Tests of rays and nearest points against brute force, with degenerate meshes, and for cracks.

use glam::DQuat;

use super::*;
use crate::nearest::nearest_on_triangle;
use crate::packet::{LANES, has};
use crate::primitives::icosphere;
use crate::random::Draws;

fn model(triangles: &[[DVec3; 3]]) -> Model {
    let mut model = Model::default();
    for triangle in triangles {
        model.add(triangle, &[], &[], &[[0, 1, 2]], 0);
    }
    model
}

fn point(draws: &mut Draws) -> DVec3 {
    2.0 * DVec3::new(draws.unit64(), draws.unit64(), draws.unit64()) - 1.0
}

/// Random triangles of all sizes, and all kinds of degenerate ones.
fn soup(count: usize, seed: u64) -> Vec<[DVec3; 3]> {
    let mut draws = Draws::new(seed, &[]);
    let mut all: Vec<[DVec3; 3]> = Vec::new();
    for i in 0..count {
        let (p, size) = (point(&mut draws), 10.0_f64.powf(0.3 - 3.0 * draws.unit64()));
        let (u, v) = (size * point(&mut draws), size * point(&mut draws));
        all.push(match i % 12 {
            // A point, a line, a line with two equal corners, a needle.
            0 => [p, p, p],
            1 => [p, p + u, p + 2.0 * u],
            2 => [p, p + u, p],
            3 => [p, p + u, p + u + 1e-9 * v],
            // An earlier triangle, identical or reversed.
            4 if i > 12 => all[i - 7],
            5 if i > 12 => [all[i - 8][2], all[i - 8][1], all[i - 8][0]],
            // Axis-aligned, through many others.
            6 => {
                [p * DVec3::new(1., 1., 0.), u * DVec3::new(1., 1., 0.), v * DVec3::new(1., 1., 0.)]
            }
            7 => [DVec3::new(0.5, p.y, p.z), DVec3::new(0.5, u.y, u.z), DVec3::new(0.5, v.y, v.z)],
            _ => [p, p + u, p + v],
        });
    }
    all
}

/// All hits in order, by testing every triangle.
fn all_hits(surface: &Surface, ray: &LocalRay) -> Vec<(f32, u32)> {
    let sheared = ShearedRay::new(ray.origin, ray.direction);
    let hit = |slot: u32| {
        let at = surface.intersect(slot, &sheared, ray.tmin, ray.tmax)?;
        Some((at.t, surface.triangle_of(slot)))
    };
    let mut all: Vec<_> = (0..surface.triangles.len() as u32).filter_map(hit).collect();
    all.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    all
}

/// The first hit, by testing every triangle.
fn brute_force(surface: &Surface, ray: &LocalRay) -> Option<(f32, u32)> {
    all_hits(surface, ray).first().copied()
}

/// The first hit, by the tree, with or without a hint.
fn closest(surface: &Surface, ray: &LocalRay, hint: Option<u32>) -> Option<(f32, u32)> {
    let hit = surface.closest(ray, None, hint, |_, _| true)?;
    Some((hit.at.t, surface.triangle_of(hit.slot)))
}

fn rays(surface: &Surface, count: usize, seed: u64) -> Vec<LocalRay> {
    let mut draws = Draws::new(seed, &[]);
    let mut all = Vec::new();
    while all.len() < count {
        let origin = 1.6 * point(&mut draws);
        let direction = match all.len() % 4 {
            0 => point(&mut draws),
            // Towards a corner, where several triangles may meet.
            1 => {
                let at = (draws.bits() % surface.triangles.len() as u64) as usize;
                surface.world_from_local(surface.triangles[at][0].as_dvec3()) - origin
            }
            // Along axes, with zeros of both signs.
            2 => {
                let sign = if draws.bits().is_multiple_of(2) { 1.0 } else { -1.0 };
                let mut axis = DVec3::splat(sign * 0.0);
                axis[(draws.bits() % 3) as usize] = sign;
                axis
            }
            _ => point(&mut draws) * DVec3::new(1.0, 1.0, -0.0),
        };
        all.extend(surface.enter(origin, direction, f64::INFINITY));
    }
    all
}

#[test]
fn the_closest_hit_agrees_with_brute_force() {
    let mut hits = 0;
    for (count, seed) in [(1, 1), (2, 2), (7, 3), (60, 4), (1500, 5)] {
        let surface = Surface::new(&model(&soup(count, seed))).expect("triangles");
        for ray in rays(&surface, 4000, seed + 100) {
            let expected = brute_force(&surface, &ray);
            assert_eq!(surface.occluder(&ray, |_, _| true).is_some(), expected.is_some());
            // The hint does not change the hit.
            for hint in [None, Some(0), Some(surface.triangles.len() as u32 / 2)] {
                let found = closest(&surface, &ray, hint);
                assert_eq!(found, expected, "{count} triangles, {ray:?}");
            }
            hits += usize::from(expected.is_some());
        }
    }
    assert!(hits > 3000, "only {hits} rays hit anything");
}

#[test]
fn later_intersections_are_complete_and_in_order() {
    let surface = Surface::new(&model(&soup(300, 8))).expect("triangles");
    for ray in rays(&surface, 500, 9) {
        let (mut after, mut found) = (None, Vec::new());
        while let Some(hit) = surface.closest(&ray, after, None, |_, _| true) {
            after = Some((hit.at.t, surface.triangle_of(hit.slot)));
            found.extend(after);
        }
        assert_eq!(found, all_hits(&surface, &ray));
    }
}

#[test]
fn no_ray_leaks_through_a_sphere() {
    let (corners, triangles) = icosphere(5);
    // Translated and rotated, so that nothing is symmetric in single precision.
    let (centre, turn) = (DVec3::new(0.37, -1.91, 12.3), DQuat::from_rotation_x(0.7));
    let place = |p: DVec3| centre + turn * p * 1.7;
    let mut sphere = Model::default();
    let placed: Vec<DVec3> = corners.iter().map(|&p| place(p)).collect();
    sphere.add(&placed, &[], &[], &triangles, 0);
    let surface = Surface::new(&sphere).expect("triangles");
    let mut draws = Draws::new(3, &[]);
    let mut leaks = 0;
    for i in 0..1_000_000_u32 {
        let [a, b, c] = triangles[(draws.bits() % triangles.len() as u64) as usize]
            .map(|corner| placed[corner as usize]);
        // Towards corners, edges and faces, from inside.
        let target = match i % 3 {
            0 => a,
            1 => a.lerp(b, draws.unit64()),
            _ => (a + b + c) / 3.0,
        };
        let inside = centre + 1.2 * point(&mut draws) * 0.5;
        let direction = target - inside;
        let hit = surface.cast(inside, direction, f64::INFINITY);
        leaks += u32::from(hit.is_none_or(|hit| (hit.t - 1.0).abs() > 1e-3));
        if i % 10 == 0 {
            // From outside, back through the target: the sphere must be hit before the point inside.
            let outside = inside + 3.0 * direction.normalize() * 1.7;
            leaks += u32::from(surface.cast(outside, inside - outside, 1.0).is_none());
        }
    }
    assert_eq!(leaks, 0);
}

#[test]
fn trees_of_any_depth_are_traversed() {
    // Sizes fall geometrically, which makes the tree deep.
    let chain: Vec<[DVec3; 3]> = (0..900)
        .map(|i| {
            let size = 0.97_f64.powi(i);
            [
                DVec3::X * size,
                DVec3::X * size + DVec3::Y * 0.01 * size,
                DVec3::X * size + DVec3::Z * 0.01 * size,
            ]
        })
        .collect();
    let same = vec![chain[0]; 5000];
    for (triangles, expected) in [(chain, 40), (same, 0)] {
        let surface = Surface::new(&model(&triangles)).expect("triangles");
        for stack in [surface.depth, SHALLOW + 1] {
            // The traversal uses a stack that is not on the heap, then one on the heap.
            let built = Surface::new(&model(&triangles)).expect("triangles");
            let surface = Surface { depth: stack.max(built.depth), ..built };
            let target = triangles[expected];
            let middle = (target[0] + target[1] + target[2]) / 3.0;
            for from in [middle + DVec3::X, middle - DVec3::X, middle - DVec3::new(1.0, 0.01, 0.0)]
            {
                let ray = surface.enter(from, middle - from, 9.0).expect("it points there");
                let found = closest(&surface, &ray, None);
                assert_eq!(found, brute_force(&surface, &ray));
                assert!(found.is_some());
            }
            assert_eq!(surface.nearest(middle).triangle, expected as u32);
        }
    }
}

#[test]
fn the_nearest_point_agrees_with_brute_force() {
    for (count, seed) in [(1, 11), (5, 12), (800, 13)] {
        let triangles = soup(count, seed);
        let surface = Surface::new(&model(&triangles)).expect("triangles");
        let traced = surface.triangles();
        let mut draws = Draws::new(seed, &[1]);
        for _ in 0..500 {
            let place = 1.5 * point(&mut draws);
            let distance = |t: &[DVec3; 3]| nearest_on_triangle(place, *t).distance(place);
            let expected = traced.iter().map(distance).fold(f64::INFINITY, f64::min);
            let found = surface.nearest(place);
            assert!((found.distance - expected).abs() < 1e-9, "{found:?} for {expected}");
            assert!((found.point.distance(place) - found.distance).abs() < 1e-9);
            assert!(distance(&traced[found.triangle as usize]) <= expected + 1e-9);
        }
    }
}

#[test]
fn nearest_points_on_one_triangle_are_exact() {
    let triangle = [DVec3::ZERO, 2.0 * DVec3::X, 2.0 * DVec3::Y];
    for (place, expected) in [
        (DVec3::new(0.5, 0.5, 3.0), DVec3::new(0.5, 0.5, 0.0)),
        (DVec3::new(-1.0, -1.0, 1.0), DVec3::ZERO),
        (DVec3::new(1.0, -1.0, 0.0), DVec3::X),
        (DVec3::new(2.0, 2.0, 1.0), DVec3::new(1.0, 1.0, 0.0)),
        (DVec3::new(5.0, -1.0, 0.0), 2.0 * DVec3::X),
    ] {
        assert!(nearest_on_triangle(place, triangle).distance(expected) < 1e-12, "{place}");
    }
    let line = [DVec3::ZERO, DVec3::X, 3.0 * DVec3::X];
    assert_eq!(nearest_on_triangle(DVec3::new(2.0, 1.0, 0.0), line), 2.0 * DVec3::X);
    assert_eq!(nearest_on_triangle(DVec3::Y, [DVec3::ONE; 3]), DVec3::ONE);
}

#[test]
fn size_and_position_of_a_mesh_do_not_matter() {
    let triangle = [DVec3::ZERO, DVec3::X, DVec3::Y];
    for (scale, offset) in [(1e-6, 0.0), (1.0, 1e6), (1e9, -1e12), (1e-30, 0.0)] {
        let moved = triangle.map(|p| p * scale + offset);
        let surface = Surface::new(&model(&[moved])).expect("triangles");
        let from = DVec3::new(0.25, 0.25, 5.0) * scale + offset;
        let hit = surface.cast(from, DVec3::NEG_Z * scale, f64::INFINITY).expect("a hit");
        assert!((hit.t - 5.0).abs() < 1e-4, "{} at scale {scale}", hit.t);
        assert!(hit.front && hit.normal.distance(DVec3::Z) < 1e-6);
        assert!(surface.cast(from, DVec3::Z * scale, f64::INFINITY).is_none());
    }
    // Neither a direction of length 0 nor a mesh of one point causes a panic.
    let surface = Surface::new(&model(&[[DVec3::ONE; 3]])).expect("triangles");
    assert!(surface.cast(DVec3::ZERO, DVec3::ZERO, 1.0).is_none());
    assert!(surface.cast(DVec3::ZERO, DVec3::ONE, 9.0).is_none());
    assert!(surface.cast(DVec3::ZERO, DVec3::NAN, 9.0).is_none());
    assert!((surface.nearest(DVec3::ZERO).distance - 3.0_f64.sqrt()).abs() < 1e-12);
    let Err(error) = Surface::new(&Model::default()) else { panic!("there is nothing") };
    assert!(error.to_string().contains("no triangle to render"), "{error}");
}

#[test]
fn a_surface_between_two_points_blocks_their_segment() {
    let wall = [DVec3::new(0., -9., -9.), DVec3::new(0., 9., -9.), DVec3::new(0., 0., 9.)];
    let surface = Surface::new(&model(&[wall])).expect("triangles");
    assert!(surface.blocked(DVec3::NEG_X, DVec3::X));
    assert!(!surface.blocked(DVec3::NEG_X, 0.5 * DVec3::NEG_X));
    // Ends on the surface do not count.
    assert!(!surface.blocked(DVec3::NEG_X, DVec3::ZERO) && !surface.blocked(DVec3::ZERO, DVec3::X));
}

#[test]
fn packets_find_the_same_hits_as_single_rays() {
    let (mut met, mut packets) = (0, 0);
    for (count, seed) in [(1, 11), (7, 12), (60, 13), (1500, 14)] {
        let surface = Surface::new(&model(&soup(count, seed))).expect("triangles");
        let mut draws = Draws::new(seed, &[1]);
        for round in 0..600 {
            // From nearly parallel, as from a pixel, to random directions.
            let spread = [1e-6, 1e-3, 0.1, 2.0][round % 4];
            let (eye, aim) = (1.6 * point(&mut draws), point(&mut draws));
            let mut rays = Vec::new();
            for _ in 0..1 + draws.bits() as usize % LANES {
                let origin =
                    eye + if round % 3 == 0 { spread * point(&mut draws) } else { DVec3::ZERO };
                let mut direction = aim - eye + spread * point(&mut draws);
                if round % 5 == 0 {
                    direction[round % 2] = 0.0;
                }
                let range = if round % 7 == 0 { 1.0 } else { f64::INFINITY };
                rays.extend(surface.enter(origin, direction, range));
            }
            // Accept all triangles, or every other one.
            for accept in [|_: u32| true, |slot: u32| slot.is_multiple_of(2)] {
                let found = surface.closest_each(&rays, |slot, _| accept(slot));
                let mut hint = Some(0).filter(|_| round % 2 == 0);
                let hidden = surface.occluded_each(&rays, &mut hint, |slot, _| accept(slot));
                for (lane, ray) in rays.iter().enumerate() {
                    let alone = surface.closest(ray, None, None, |slot, _| accept(slot));
                    let summary = |hit: Option<LocalHit>| hit.map(|hit| (hit.slot, hit.at));
                    assert_eq!(summary(found[lane]), summary(alone), "{count} triangles, {ray:?}");
                    assert_eq!(has(hidden, lane), alone.is_some(), "{count} triangles, {ray:?}");
                    met += usize::from(alone.is_some());
                }
                assert!(found[rays.len()..].iter().all(Option::is_none));
                assert_eq!(hidden.checked_shr(rays.len() as u32).unwrap_or(0), 0);
                packets += 1;
            }
        }
    }
    assert!(met > packets, "{met} rays of {packets} packets hit anything");
}

#[test]
fn no_ray_hits_a_mesh_that_its_pyramid_misses() {
    let surface = Surface::new(&model(&soup(40, 21))).expect("triangles");
    let mut draws = Draws::new(22, &[]);
    let (mut missing, mut wrong) = (0, Vec::new());
    for _ in 0..4000 {
        let (eye, aim) = (2.5 * point(&mut draws), 1.5 * point(&mut draws));
        let (u, v) = (0.2 * point(&mut draws), 0.2 * point(&mut draws));
        let at = |x: f64, y: f64| aim - eye + x * u + y * v;
        let corners = [at(-1.01, -1.01), at(1.01, -1.01), at(-1.01, 1.01), at(1.01, 1.01)];
        if !surface.is_missed_by(eye, corners) {
            continue;
        }
        missing += 1;
        for _ in 0..20 {
            let direction = at(2.0 * draws.unit64() - 1.0, 2.0 * draws.unit64() - 1.0);
            wrong.extend(surface.cast(eye, direction, f64::INFINITY));
        }
    }
    assert!(missing > 200, "only {missing} pyramids miss everything");
    assert!(wrong.is_empty(), "{} rays hit something", wrong.len());
}
