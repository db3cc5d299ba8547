//! Compares given depth with the points that the views see: a wrong unit or scale, distances along rays, inverse depth
//! and shifted maps all show in the ratios of the two.
//!
//! No tracks are needed: each cell of a picture shows its nearest point. Hidden points get through where a cell has no
//! nearer one, so all measures here are modes and shortest intervals, which a minority of outliers does not move.

use densify_core::camera::Camera;
use glam::{DVec2, DVec3};

/// Cells along each side of a picture.
const CELLS: usize = 24;
/// Fewest pairs of a point and a known depth for any statement.
pub(super) const MIN_PAIRS: usize = 40;
/// A hypothesis is accepted if it narrows the ratios to this share.
const NARROWER: f64 = 0.7;
/// Largest shift of depth against colour that is looked for `[px]`.
const MAX_SHIFT: i32 = 4;
/// Relative difference at which a point no longer agrees with the map.
const AGREES: f64 = 0.03;
/// A shift is reported if it lowers the mean disagreement to this share.
const CLEARER: f64 = 0.85;

/// Distance between pairs that exchange their depths; a prime, so that they are far apart.
const STRIDE: usize = 7919;

/// A point that a view sees.
#[derive(Debug, Clone, Copy)]
pub(super) struct SeenPoint {
    /// Place in the view `[px]`.
    pub(super) pixel: DVec2,
    /// Depth along the view's axis `[scene units]`.
    pub(super) depth: f64,
}

/// The nearest point in each cell of a view's picture.
pub(super) fn seen_points(points: &[DVec3], camera: &Camera) -> Vec<SeenPoint> {
    let mut nearest: Vec<Option<SeenPoint>> = vec![None; CELLS * CELLS];
    for &point in points {
        let Some((pixel, depth)) = camera.place_in_image(point, 0.0) else { continue };
        let along = |pixel: f64, size: u32| {
            ((pixel / f64::from(size) * CELLS as f64) as usize).min(CELLS - 1)
        };
        let cell = along(pixel.y, camera.height) * CELLS + along(pixel.x, camera.width);
        let cell = &mut nearest[cell];
        if cell.is_none_or(|seen| depth < seen.depth) {
            *cell = Some(SeenPoint { pixel, depth });
        }
    }
    nearest.into_iter().flatten().collect()
}

/// A point with the depth of the map at its place.
#[derive(Debug, Clone, Copy)]
struct Pair {
    /// ln of the point's depth.
    point: f64,
    /// ln of the map's depth.
    map: f64,
    /// ln of the ray's length at depth 1.
    ray: f64,
}

/// Pairs of points and depths, over several views.
#[derive(Debug, Default)]
pub(super) struct Agreement {
    pairs: Vec<Pair>,
    /// Sum of the disagreements for each shift, row-major, and their number.
    shifted: Vec<(f64, usize)>,
    /// Mode of ln(map / point) of each view with enough pairs.
    by_view: Vec<f64>,
}

/// The result of the comparison.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Verdict {
    /// Number of pairs.
    pub(super) pairs: usize,
    /// Typical ratio of the map's depth to that of the points.
    pub(super) scale: f64,
    /// Half of the ratios differ from each other by at most this much, relatively.
    pub(super) spread: f64,
    /// The same, if every point had the map's depth of another place.
    pub(super) unrelated_spread: f64,
    /// The kind of error that the ratios show, other than a wrong scale.
    pub(super) fault: Option<Fault>,
    /// Half of the views differ in their scales by at least this much, relatively; 0 with few views.
    pub(super) between_views: f64,
}

/// An error in the meaning of depth.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Fault {
    /// The values are distances along rays although they are read as depth.
    AlongRays,
    /// The values are depth along the axis although they are read as distances along rays.
    AlongAxis,
    /// The values are inverse depth.
    Inverse,
    /// The map is displaced by this many pixels to the right and down.
    Shifted(i32, i32),
}

impl Agreement {
    /// Adds a view: its points, and its inverse depths `[1/scene units]`.
    pub(super) fn add(&mut self, camera: &Camera, seen: &[SeenPoint], inverse: &[f32]) {
        let (width, height) = (i64::from(camera.width), i64::from(camera.height));
        let depth_at = |pixel: DVec2, (dx, dy): (i32, i32)| {
            let (x, y) = (pixel.x as i64 + i64::from(dx), pixel.y as i64 + i64::from(dy));
            let inside = (0..width).contains(&x) && (0..height).contains(&y);
            let value = if inside { inverse[(y * width + x) as usize] } else { 0.0 };
            (value > 0.0 && value.is_finite()).then(|| -f64::from(value).ln())
        };
        let first = self.pairs.len();
        self.pairs.extend(seen.iter().filter_map(|seen| {
            let middle = DVec2::new(camera.cx, camera.cy);
            let ray = ((seen.pixel - middle) / DVec2::new(camera.fx, camera.fy)).extend(1.0);
            let map = depth_at(seen.pixel, (0, 0))?;
            Some(Pair { point: seen.depth.ln(), map, ray: ray.length().ln() })
        }));
        let mut ratios: Vec<f64> =
            self.pairs[first..].iter().map(|pair| pair.map - pair.point).collect();
        if ratios.len() < MIN_PAIRS / 4 {
            return;
        }
        let own = mode(&mut ratios);
        self.by_view.push(own);
        // Only points that all shifts cover are compared. A shift along a slanted surface changes the scale, so each shift
        // is compared at its own.
        let mut shifted: Vec<Vec<f64>> = vec![Vec::new(); shifts().count()];
        for seen in seen {
            let depths: Option<Vec<f64>> =
                shifts().map(|shift| depth_at(seen.pixel, shift)).collect();
            for (ratios, map) in shifted.iter_mut().zip(depths.into_iter().flatten()) {
                ratios.push(map - seen.depth.ln());
            }
        }
        self.shifted.resize(shifted.len(), (0.0, 0));
        for ((sum, count), mut ratios) in self.shifted.iter_mut().zip(shifted) {
            let own = mode(&mut ratios);
            *sum += ratios.iter().map(|ratio| (ratio - own).abs().min(AGREES)).sum::<f64>();
            *count += ratios.len();
        }
    }

    /// The result; `None` with too few pairs.
    pub(super) fn verdict(&self) -> Option<Verdict> {
        if self.pairs.len() < MIN_PAIRS {
            return None;
        }
        let measure = |value: &dyn Fn(&Pair) -> f64| {
            let mut values: Vec<f64> = self.pairs.iter().map(value).collect();
            let scale = mode(&mut values);
            (scale, spread(&values))
        };
        let (scale, plain) = measure(&|pair| pair.map - pair.point);
        let others = [
            (Fault::AlongRays, measure(&|pair| pair.map - pair.point - pair.ray).1),
            (Fault::AlongAxis, measure(&|pair| pair.map - pair.point + pair.ray).1),
            (Fault::Inverse, measure(&|pair| pair.map + pair.point).1),
        ];
        let narrowest = others.into_iter().min_by(|a, b| a.1.total_cmp(&b.1));
        let meaning =
            narrowest.filter(|(_, other)| *other < NARROWER * plain).map(|(fault, _)| fault);
        let mut views = self.by_view.clone();
        let between_views = if views.len() < 4 { 0.0 } else { mode_spread(&mut views) };
        Some(Verdict {
            pairs: self.pairs.len(),
            scale: scale.exp(),
            spread: plain.exp_m1(),
            unrelated_spread: self.unrelated_spread().exp_m1(),
            fault: meaning.or_else(|| self.shift()),
            between_views: between_views.exp_m1(),
        })
    }

    /// The spread of ln(map / point) if points and depths are paired at random.
    fn unrelated_spread(&self) -> f64 {
        let others = (0..self.pairs.len()).map(|i| i * STRIDE % self.pairs.len());
        let pairs = self.pairs.iter().zip(others);
        let mut values: Vec<f64> =
            pairs.map(|(pair, other)| self.pairs[other].map - pair.point).collect();
        values.sort_unstable_by(f64::total_cmp);
        spread(&values)
    }

    /// The shift at which points and map agree clearly better than without any.
    fn shift(&self) -> Option<Fault> {
        let means = self.shifted.iter().map(|(sum, count)| sum / (*count).max(1) as f64);
        let all: Vec<((i32, i32), f64)> = shifts().zip(means).collect();
        let (best, least) = *all.iter().min_by(|a, b| a.1.total_cmp(&b.1))?;
        let (_, unshifted) = *all.iter().find(|(shift, _)| *shift == (0, 0))?;
        // A neighbouring pixel may agree as well by chance, as the points themselves are a pixel off.
        let is_far = best.0.abs().max(best.1.abs()) > 1;
        let counted = self.shifted.first().is_some_and(|(_, count)| *count >= MIN_PAIRS);
        (is_far && counted && least < CLEARER * unshifted).then_some(Fault::Shifted(best.0, best.1))
    }
}

/// All shifts that are tried, in a fixed order.
fn shifts() -> impl Iterator<Item = (i32, i32)> {
    (-MAX_SHIFT..=MAX_SHIFT).flat_map(|dy| (-MAX_SHIFT..=MAX_SHIFT).map(move |dx| (dx, dy)))
}

/// The half-sample mode: the densest half of the values, then the densest half of these, and so on (Bickel and
/// Frühwirth 2006), and at the end the mean of the values near that place. Sorts the values.
fn mode(values: &mut [f64]) -> f64 {
    values.sort_unstable_by(f64::total_cmp);
    let mut rest = &*values;
    while rest.len() > 3 {
        rest = densest_half(rest);
    }
    let middle = rest.iter().sum::<f64>() / rest.len().max(1) as f64;
    // The mode alone would depend on a few values only.
    let near = 0.5 * spread(values);
    let near = values.iter().filter(|value| (**value - middle).abs() <= near);
    let (sum, count) = near.fold((0.0, 0), |(sum, count), value| (sum + value, count + 1));
    if count > 0 { sum / f64::from(count) } else { middle }
}

/// The length of the shortest interval that holds half of the sorted values.
fn spread(sorted: &[f64]) -> f64 {
    let half = densest_half(sorted);
    half.last().zip(half.first()).map_or(0.0, |(last, first)| last - first)
}

fn mode_spread(values: &mut [f64]) -> f64 {
    values.sort_unstable_by(f64::total_cmp);
    spread(values)
}

/// The half of the sorted values that lies in the shortest interval.
fn densest_half(sorted: &[f64]) -> &[f64] {
    let count = sorted.len().div_ceil(2);
    let width = |first: usize| sorted[first + count - 1] - sorted[first];
    let first = (0..=sorted.len() - count).min_by(|&a, &b| width(a).total_cmp(&width(b)));
    first.map_or(sorted, |first| &sorted[first..first + count])
}

#[cfg(test)]
mod tests {
    use glam::DMat3;

    use super::*;

    const SIDE: u32 = 96;

    fn camera() -> Camera {
        let focal = f64::from(SIDE) * 0.6;
        Camera::centred((SIDE, SIDE), (focal, focal), DMat3::IDENTITY, DVec3::ZERO)
    }

    /// Depth of a scene with a slanted floor and blocks that stand out from it.
    fn depth(pixel: DVec2) -> f64 {
        let floor = 4.0 + 0.03 * pixel.y;
        let block = (pixel.x / 9.0).floor() as i64 + (pixel.y / 11.0).floor() as i64;
        if block.rem_euclid(2) == 0 { 0.6 * floor } else { floor }
    }

    fn ray(pixel: DVec2) -> f64 {
        let camera = camera();
        ((pixel - DVec2::new(camera.cx, camera.cy)) / camera.fx).extend(1.0).length()
    }

    /// The verdict on a map with these depths, against points with noise and a fifth of them wrong.
    fn verdict(map: impl Fn(DVec2) -> f64) -> Verdict {
        let mut agreement = Agreement::default();
        for view in 0..4 {
            let seen: Vec<SeenPoint> = (0..300)
                .map(|i| {
                    let noise = |salt: u64| {
                        let mixed =
                            (i + 300 * view + salt * 7919).wrapping_mul(0x9E37_79B9_7F4A_7C15);
                        (mixed >> 11) as f64 / (1_u64 << 53) as f64
                    };
                    let pixel = DVec2::new(noise(1), noise(2)) * f64::from(SIDE);
                    let wrong = if i % 5 == 0 { 1.0 + noise(3) } else { 1.0 };
                    SeenPoint {
                        pixel,
                        depth: depth(pixel) * (1.0 + 0.01 * (noise(4) - 0.5)) * wrong,
                    }
                })
                .collect();
            let place = |i: u32| DVec2::new(f64::from(i % SIDE) + 0.5, f64::from(i / SIDE) + 0.5);
            let inverse: Vec<f32> =
                (0..SIDE * SIDE).map(|i| (1.0 / map(place(i))) as f32).collect();
            agreement.add(&camera(), &seen, &inverse);
        }
        agreement.verdict().unwrap()
    }

    #[test]
    fn true_depth_agrees_and_scales_are_measured() {
        for scale in [1.0, 1.05, 0.95, 1000.0, 0.3048] {
            let found = verdict(|pixel| scale * depth(pixel));
            assert!((found.scale / scale - 1.0).abs() < 0.005, "{found:?} for {scale}");
            assert!(found.fault.is_none() && found.spread < 0.02, "{found:?} for {scale}");
        }
    }

    #[test]
    fn distances_along_rays_and_inverse_depth_are_recognised() {
        let fault = |map: &dyn Fn(DVec2) -> f64| verdict(map).fault;
        assert_eq!(fault(&|pixel| depth(pixel) * ray(pixel)), Some(Fault::AlongRays));
        assert_eq!(fault(&|pixel| depth(pixel) / ray(pixel)), Some(Fault::AlongAxis));
        assert_eq!(fault(&|pixel| 7.0 / depth(pixel)), Some(Fault::Inverse));
    }

    #[test]
    fn shifted_maps_are_recognised() {
        for (dx, dy) in [(2, 0), (0, -3), (-2, 2)] {
            let shift = DVec2::new(f64::from(dx), f64::from(dy));
            let found = verdict(|pixel| depth(pixel - shift));
            assert_eq!(found.fault, Some(Fault::Shifted(dx, dy)), "{found:?}");
        }
    }

    #[test]
    fn too_few_points_give_no_verdict() {
        assert_eq!(Agreement::default().verdict(), None);
    }

    #[test]
    fn hidden_points_do_not_move_the_mode() {
        let mut values: Vec<f64> = (0..60).map(|i| 0.3 + 0.0001 * f64::from(i)).collect();
        values.extend((0..50).map(|i| -0.1 - 0.03 * f64::from(i)));
        assert!((mode(&mut values) - 0.303).abs() < 0.002);
        assert!(mode(&mut []).abs() < f64::EPSILON);
    }
}
