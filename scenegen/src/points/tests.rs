//! Tests of the number, positions and errors of initial points.

use super::*;
use crate::{Options, Scene, Source, generate};

fn points(name: &str, size: u32, options: PointOptions) -> (Scene, InitPoints) {
    let options = Options {
        size: Some((size, size)),
        train: Some(12),
        test: Some(1),
        grid: 2,
        points: options,
        ..Options::default()
    };
    let made = generate(&Source::Preset(name.into()), &options).expect("preset");
    (made.scene, made.points)
}

const EXACT: PointOptions =
    PointOptions { count: 800, noise: 0.0, outliers: 0.0, dropout: 0.0, without_thin: false };

#[test]
fn exact_points_lie_on_surfaces_that_three_views_see() {
    let (scene, points) = points("spheres", 64, EXACT);
    assert_eq!((points.positions.len(), points.outliers), (800, 0));
    let diagonal = scene.surface.diagonal();
    for (position, seen) in points.positions.iter().zip(&points.seen_by) {
        assert!(scene.surface.nearest(*position).distance < 1e-6 * diagonal);
        assert!(seen.len() >= 3 && seen.windows(2).all(|pair| pair[0] < pair[1]));
        for &view in seen {
            let camera = &scene.views[view as usize].camera;
            let (pixel, depth) = camera.project(*position);
            assert!(depth > 0.0 && camera.contains(pixel));
            // Nothing is in front of it, up to the tolerance.
            let ray = *position - camera.centre;
            let first = scene.surface.cast(camera.centre, ray, 2.0).expect("a surface");
            assert!(first.t > 1.0 - 2.0 * SAME_DEPTH, "{}", first.t);
        }
    }
}

#[test]
fn noise_and_outliers_have_the_requested_size() {
    let options = PointOptions { noise: 2e-3, outliers: 0.1, count: 1500, ..EXACT };
    let (scene, points) = points("spheres", 64, options);
    assert!((100..200).contains(&points.outliers), "{} outliers", points.outliers);
    let mut distances: Vec<f64> = points
        .positions
        .iter()
        .map(|&p| scene.surface.nearest(p).distance / scene.surface.diagonal())
        .collect();
    distances.sort_by(f64::total_cmp);
    // The distance of a point from its plane is the noise along the normal, with a median of 0.674 standard deviations.
    // The outliers, a tenth of the points, are the farthest.
    let median = distances[distances.len() * 45 / 100] / 2e-3;
    assert!((0.5..0.8).contains(&median), "{median}");
}

#[test]
fn detail_has_more_points_than_plain_walls() {
    let (scene, points) = points("chirp", 96, EXACT);
    let plain = |p: &&DVec3| {
        let triangle = scene.surface.nearest(**p).triangle as usize;
        let material = scene.model.triangle_materials[triangle] as usize;
        scene.model.materials[material].base_texture.is_none()
    };
    let plain = points.positions.iter().filter(plain).count();
    assert!(plain * 5 < points.positions.len(), "{plain} of {}", points.positions.len());
}

#[test]
fn thin_structures_and_patches_are_excluded_on_request() {
    let on_thin = |scene: &Scene, points: &InitPoints| {
        let thin = |p: &&DVec3| scene.model.is_thin(scene.surface.nearest(**p).triangle);
        points.positions.iter().filter(thin).count()
    };
    let (scene, with) = points("thin", 96, EXACT);
    assert!(on_thin(&scene, &with) > 20);
    let (scene, without) = points("thin", 96, PointOptions { without_thin: true, ..EXACT });
    assert_eq!(on_thin(&scene, &without), 0);
    assert!(without.positions.len() > 500);
    let half = PointOptions { dropout: 0.5, count: 100_000, ..EXACT };
    let (_, all) = points("spheres", 48, PointOptions { dropout: 0.0, ..half });
    let (_, dropped) = points("spheres", 48, PointOptions { count: all.positions.len(), ..half });
    assert!(dropped.positions.len() < all.positions.len());
}
