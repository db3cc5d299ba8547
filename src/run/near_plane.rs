//! The near plane: as the user gives it, or else in front of nearly all points that the views show.
//!
//! The extent of the cameras says nothing about the distance of the nearest surface: in a corridor of 120 m, 0.04 of
//! the extent is 2.6 m, and the walls on both sides are nearer.

use densify_core::spelling::Spelling;
use densify_data::dataset::normalise::EXTENT;
use densify_data::dataset::{Dataset, SeenDepths};

use crate::failure::notes;
use crate::spec::Fraction;

/// The farthest near plane that is chosen `[fraction of the extent]`: that of the original trainer, 0.2 at an extent of
/// 5. With nearer planes, Gaussians become fog in front of single cameras: with 0.01, test views lost up to 10 dB.
const FARTHEST: f64 = 0.04;
/// The nearest near plane that is chosen `[fraction of the extent]`: the smallest size of a Gaussian made from a point.
const NEAREST: f64 = 2e-4;
/// The share of what the views show that may be nearer than the plane: reconstructions have stray points.
const STRAY_SHARE: f64 = 0.005;
/// The near plane as a fraction of the depth of the nearest points, stray ones aside. It is below 1 because points only
/// sample the surfaces, and because cameras of other views may be nearer to these surfaces.
const DEPTH_FACTOR: f64 = 0.5;

/// The near plane of a run, or of a model with the dataset that it is shown with.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NearPlane {
    /// Distance from the camera `[fraction of the extent]`.
    pub fraction: Fraction,
    /// True if the user gave this plane.
    is_given: bool,
    /// The share of what the views show that is nearer than this plane.
    hidden: f64,
    /// The share of what the views show that is nearer than [`FARTHEST`].
    hidden_at_farthest: f64,
}

impl NearPlane {
    /// The plane that is given, or else one that follows from the points that the dataset's views show.
    pub fn choose(given: Option<Fraction>, dataset: &Dataset) -> Self {
        Self::from_depths(given, &dataset.seen_depths())
    }

    /// As [`choose`](Self::choose), from depths in a normalised scene.
    pub fn from_depths(given: Option<Fraction>, seen: &SeenDepths) -> Self {
        let nearest = seen.quantile(STRAY_SHARE).map(|depth| DEPTH_FACTOR * depth / EXTENT);
        let fraction = given.unwrap_or(Fraction(match nearest {
            Some(nearest) if nearest < FARTHEST => two_digits(nearest.max(NEAREST)),
            _ => FARTHEST,
        }));
        Self {
            fraction,
            is_given: given.is_some(),
            hidden: seen.share_below(fraction.0 * EXTENT),
            hidden_at_farthest: seen.share_below(FARTHEST * EXTENT),
        }
    }

    /// The distance of the plane from the camera `[scene units]`.
    pub fn distance(&self) -> f32 {
        Self::distance_of(self.fraction)
    }

    /// The distance of a plane at this fraction of the extent `[scene units]`.
    pub fn distance_of(fraction: Fraction) -> f32 {
        (fraction.0 * EXTENT) as f32
    }

    /// A line for the user if the chosen plane is nearer than 0.04 of the extent, or if the plane hides points.
    pub fn line(&self, spelling: Spelling) -> Option<String> {
        let near = self.fraction.0;
        let percent = |share: f64| format!("{:.2} %", 100.0 * share);
        let hidden = percent(self.hidden);
        if !self.is_given && near < FARTHEST {
            let usual = percent(self.hidden_at_farthest);
            return Some(format!(
                "near     {near} of the extent: hides {hidden} of what the views show; {FARTHEST} would hide {usual}"
            ));
        }
        (self.hidden > 0.0).then(|| notes::hidden_points(spelling, near, &hidden, self.is_given))
    }
}

/// The number cut to two significant digits, so that it reads well in files.
fn two_digits(number: f64) -> f64 {
    let digits = 1 - number.log10().floor() as i32;
    let whole = (number * 10f64.powi(digits)).floor();
    format!("{whole}e{}", -digits).parse().unwrap_or(number)
}

#[cfg(test)]
#[allow(clippy::float_cmp, reason = "results are exact")]
pub(crate) mod tests {
    use densify_core::camera::Camera;
    use glam::{DMat3, DVec3};

    use super::*;

    /// The depths that cameras see if each camera faces a wall of its own, at one of these depths.
    pub(crate) fn walls(depths: &[f64]) -> SeenDepths {
        let at = |z: f64, i: usize| z * (2.0 * (i as f64 + 0.5) / 32.0 - 1.0);
        let mut points = Vec::new();
        let mut cameras = Vec::new();
        for (number, &z) in depths.iter().enumerate() {
            let centre = DVec3::X * (1e4 * number as f64);
            cameras.push(Camera::centred((64, 64), (32.0, 32.0), DMat3::IDENTITY, centre));
            points.extend((0..1024).map(|i| centre + DVec3::new(at(z, i % 32), at(z, i / 32), z)));
        }
        SeenDepths::measure(&points, &cameras)
    }

    #[test]
    fn the_chosen_plane_follows_the_seen_depths_up_to_the_farthest() {
        let chosen = |depths: &[f64]| NearPlane::from_depths(None, &walls(depths));
        let fraction = |depths: &[f64]| chosen(depths).fraction.0;
        assert_eq!(fraction(&[0.1, 3.0]), FARTHEST);
        assert_eq!(chosen(&[0.1, 3.0]).line(Spelling::Terminal), None);
        assert_eq!(chosen(&[]).fraction.0, FARTHEST, "nothing is known");
        // 0.5 · 0.0221 / 1.1, though only one view in four sees this wall.
        assert_eq!(fraction(&[0.0221, 3.0, 3.0, 3.0]), 0.01);
        assert_eq!(fraction(&[1e-7, 3.0]), NEAREST);
        // One view in 300 is a third of a percent: stray points.
        let mut far = vec![3.0; 300];
        far[7] = 0.02;
        let stray = chosen(&far);
        assert_eq!(stray.fraction.0, FARTHEST);
        let line = stray.line(Spelling::Terminal).expect("points lie nearer");
        assert!(line.contains("0.33") && line.contains("--near"), "{line}");
        let line = chosen(&[0.0221, 3.0]).line(Spelling::Terminal).expect("it is nearer");
        assert!(line.contains("0.01 ") && line.contains("50"), "{line}");
    }

    #[test]
    fn a_given_plane_is_kept_and_what_it_hides_is_reported() {
        let given = NearPlane::from_depths(Some(Fraction(0.3)), &walls(&[0.1, 3.0]));
        assert_eq!(given.distance(), (0.3 * EXTENT) as f32);
        let line = given.line(Spelling::Terminal).expect("points lie nearer");
        assert!(line.contains("50") && line.contains("--near 0.3"), "{line}");
        let given = NearPlane::from_depths(Some(Fraction(0.003)), &walls(&[0.1, 3.0]));
        assert_eq!((given.fraction.0, given.line(Spelling::Terminal)), (0.003, None));
    }

    #[test]
    fn fractions_are_cut_to_two_digits() {
        for (number, expected) in
            [(0.0123, 0.012), (0.00999, 0.0099), (0.01, 0.01), (2e-4, 2e-4), (0.039_999, 0.039)]
        {
            assert_eq!(two_digits(number), expected);
        }
    }
}
