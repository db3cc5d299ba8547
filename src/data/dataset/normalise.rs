//! Moves scenes to normalised coordinates in f64, so that remote and tiny scenes lose no precision in f32.
//!
//! The unit of the scene is the largest distance of a training camera from the mean of all training cameras, as in
//! NeRF++ (Zhang et al. 2020, §4); 3DGS calls 1.1 times this distance the extent. Rotations do not change, so
//! quaternions and spherical harmonics do not either.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::models::round_origin;
use densify_core::camera::Camera;
use densify_core::gaussians::Gaussians;

/// Extent of every normalised scene `[scene units]`: 3DGS defines it as 1.1 times the radius of the cameras
/// (`getNerfppNorm`).
pub const EXTENT: f64 = 1.1;
/// Cameras count as being at one place if their radius is below this fraction of their distance from the origin:
/// the precision of f64 is 2.2e-16, and poses of other programs have a few digits less.
const SAME_PLACE: f64 = 1e-12;
/// Distance from the origin, in radii of the cameras, below which f32 world coordinates are fine enough for all
/// Gaussians: at 50 radii, f32 has steps of at most 4e-6 radii, a fiftieth of the smallest Gaussian made from a point.
const F32_DISTANCE: f64 = 50.0;

/// A camera is an outlier if its distance from the median position exceeds this many times the median of all these
/// distances. Drone flights and walks around an object stay below 5.
const OUTLIER_DISTANCE: f64 = 10.0;
/// Largest share of the cameras that can be outliers. If more cameras are that far away, they are a part of the scene.
const MAX_OUTLIERS: f64 = 0.05;
/// Smallest number of cameras among which outliers can be recognised.
const MIN_CAMERAS: usize = 10;

/// The transform scene = (world − centre) · scale.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Normalisation {
    /// The world point at the origin of the scene.
    pub centre: DVec3,
    /// Scene units per world unit, > 0.
    pub scale: f64,
}

/// The mean of the centres and their largest distance from it.
fn mean_and_radius(centres: &[DVec3]) -> (DVec3, f64) {
    let centre = centres.iter().sum::<DVec3>() / centres.len().max(1) as f64;
    (centre, centres.iter().map(|c| c.distance(centre)).fold(0.0, f64::max))
}

/// The upper median; `None` without values.
pub fn median(mut values: Vec<f64>) -> Option<f64> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Marks the few cameras that are far away from all others; their poses are probably wrong. Shape: `[cameras]`.
pub(super) fn outliers(centres: &[DVec3]) -> Vec<bool> {
    let along = |axis: usize| {
        median(centres.iter().map(|centre| centre[axis]).collect()).unwrap_or_default()
    };
    let middle = DVec3::new(along(0), along(1), along(2));
    let distances: Vec<f64> = centres.iter().map(|centre| centre.distance(middle)).collect();
    let unit = median(distances.clone()).unwrap_or_default();
    let is_one_place = unit <= SAME_PLACE * middle.length();
    if is_one_place || centres.len() < MIN_CAMERAS {
        return vec![false; centres.len()];
    }
    let far: Vec<bool> = distances.iter().map(|&d| d > OUTLIER_DISTANCE * unit).collect();
    let count = far.iter().filter(|&&far| far).count();
    let max_count = ((MAX_OUTLIERS * centres.len() as f64) as usize).max(1);
    if count > max_count { vec![false; centres.len()] } else { far }
}

impl Normalisation {
    /// The identity.
    pub const IDENTITY: Self = Self { centre: DVec3::ZERO, scale: 1.0 };

    /// Normalises a model without cameras: the median of its means becomes the origin, and four fifths of them are
    /// within distance 1.
    pub fn fit_model(model: &Gaussians) -> Self {
        let middle = |axis: usize| {
            let along = model.means.iter().map(|mean| f64::from(mean[axis]));
            median(along.collect()).unwrap_or_default() + model.origin[axis]
        };
        let centre = DVec3::new(middle(0), middle(1), middle(2));
        let away = |row| DVec3::from(model.position(row)).distance(centre);
        let mut away: Vec<f64> = (0..model.len()).map(away).collect();
        away.sort_unstable_by(f64::total_cmp);
        // The farthest fifth is mostly background, which may be very far away.
        let near =
            away.get(away.len().saturating_sub(1) * 4 / 5).copied().filter(|&near| near > 0.0);
        let all = || away.last().map_or(1.0, |last| last.max(1.0));
        let scale = 1.0 / near.unwrap_or_else(all);
        if scale.is_normal() && centre.is_finite() {
            Self { centre, scale }
        } else {
            Self::IDENTITY
        }
    }

    /// Moves the mean of the camera centres to the origin and the farthest of them to distance 1. If all cameras are at
    /// one place, the median distance of the points becomes 1; without points the unit stays the same.
    pub fn fit(centres: &[DVec3], points: &[DVec3]) -> Self {
        let (centre, mut unit) = mean_and_radius(centres);
        if unit <= SAME_PLACE * centre.length() {
            unit = median(points.iter().map(|p| p.distance(centre)).collect()).unwrap_or(1.0);
        }
        let scale = 1.0 / unit;
        // A unit of zero, or without a normal inverse, is not usable.
        Self { centre, scale: if scale.is_normal() { scale } else { 1.0 } }
    }

    /// Transforms a point from world to scene coordinates.
    pub fn scene_from_world(&self, world: DVec3) -> DVec3 {
        (world - self.centre) * self.scale
    }

    /// Transforms a point from scene to world coordinates.
    pub fn world_from_scene(&self, scene: DVec3) -> DVec3 {
        scene / self.scale + self.centre
    }

    /// Transforms a camera from world to scene coordinates.
    pub fn scene_from_world_camera(&self, world: &Camera) -> Camera {
        let translation = (world.rotation * self.centre + world.translation) * self.scale;
        Camera { translation, ..*world }
    }

    /// Transforms a camera from scene to world coordinates.
    pub fn world_from_scene_camera(&self, scene: &Camera) -> Camera {
        let translation = scene.translation / self.scale - scene.rotation * self.centre;
        Camera { translation, ..*scene }
    }

    /// Transforms a model from scene to world coordinates, computing in f64. The means are measured from `origin`, a
    /// world point.
    pub fn world_from_model(&self, scene: Gaussians, origin: [f64; 3]) -> Gaussians {
        let from_scene = |scene| self.world_from_scene(scene);
        self.mapped(scene, origin, -self.scale.ln(), from_scene)
    }

    /// Transforms a model from world to scene coordinates, computing in f64.
    pub fn model_from_world(&self, world: Gaussians) -> Gaussians {
        self.mapped(world, [0.0; 3], self.scale.ln(), |world| self.scene_from_world(world))
    }

    /// Maps positions by `point`, measures means from `origin` and adds `ln_scale` to log-scales. Works in place, as
    /// the model may take most of the memory.
    fn mapped(
        &self,
        mut model: Gaussians,
        origin: [f64; 3],
        ln_scale: f64,
        point: impl Fn(DVec3) -> DVec3,
    ) -> Gaussians {
        if *self == Self::IDENTITY {
            return model.with_origin(origin);
        }
        for row in 0..model.len() {
            let moved = point(DVec3::from(model.position(row)));
            model.means[row] = (moved - DVec3::from(origin)).as_vec3().to_array();
        }
        model.origin = origin;
        for value in model.log_scales.as_flattened_mut() {
            *value = (f64::from(*value) + ln_scale) as f32;
        }
        model
    }

    /// Returns true if the scene is so far from the origin that world coordinates in f32 may be too coarse for it.
    pub fn is_remote(&self) -> bool {
        self.centre.length() * self.scale > F32_DISTANCE
    }

    /// The world point from which local coordinates are measured: the centre of the scene, rounded to multiples of a
    /// power of ten below the radius of the cameras.
    pub fn local_origin(&self) -> [f64; 3] {
        round_origin(self.centre.to_array(), 1.0 / self.scale)
    }
}

#[cfg(test)]
#[allow(clippy::float_cmp, reason = "results are exact")]
mod tests {
    use glam::DMat3;

    use super::*;
    use densify_core::antialiasing::Antialiasing;

    #[test]
    fn a_few_cameras_far_from_all_others_are_outliers() {
        let ring = |count: usize, radius: f64| -> Vec<DVec3> {
            let angle = |number: usize| number as f64 / count as f64 * std::f64::consts::TAU;
            (0..count).map(|n| DVec3::new(angle(n).cos(), angle(n).sin(), 0.2) * radius).collect()
        };
        let far_of = |near: usize, lonely: &[f64]| -> Vec<usize> {
            let mut centres = ring(near, 3.0);
            centres.extend(lonely.iter().map(|&x| DVec3::new(x, 0.0, 0.0)));
            let far = outliers(&centres).into_iter().enumerate().filter(|(_, far)| *far);
            far.map(|(number, _)| number).collect()
        };
        assert_eq!(far_of(39, &[500.0]), [39]);
        assert_eq!(far_of(39, &[40.0, -1e30]), [39, 40]);
        assert_eq!(far_of(39, &[25.0]), [0; 0]);
        // Three far cameras are a part of the scene, and among nine cameras no outlier is recognised.
        assert_eq!(far_of(38, &[500.0, 510.0, 520.0]), [0; 0]);
        assert_eq!(far_of(8, &[500.0]), [0; 0]);
        assert_eq!(outliers(&vec![DVec3::ONE; 30]), [false; 30]);
    }

    fn camera(centre: DVec3) -> Camera {
        let rotation = DMat3::from_rotation_y(0.4) * DMat3::from_rotation_x(0.9);
        Camera::centred((200, 160), (200.0, 210.0), rotation, centre)
    }

    #[test]
    fn the_farthest_camera_is_at_distance_one() {
        let offset = DVec3::new(4e6, -5e6, 300.0);
        let centres = [DVec3::X * 3.0, DVec3::Y * 5.0, DVec3::Z * -2.0].map(|c| c + offset);
        let n = Normalisation::fit(&centres, &[]);
        let scene = centres.map(|c| n.scene_from_world_camera(&camera(c)).centre());
        assert!((mean_and_radius(&scene).1 - 1.0).abs() < 1e-8);
        assert!((scene.iter().sum::<DVec3>()).length() < 1e-8);
        assert!(n.is_remote() && !Normalisation::fit(&[DVec3::X, DVec3::Y], &[]).is_remote());
        assert_eq!(n.local_origin(), [4e6 + 1.0, -5e6 + 2.0, 299.0]);
    }

    #[test]
    fn projections_do_not_change_and_depths_scale() {
        let n = Normalisation { centre: DVec3::new(10.0, 20.0, -30.0), scale: 0.25 };
        let world = camera(DVec3::new(9.0, 18.0, -33.0));
        let point = DVec3::new(10.0, 21.0, -29.0);
        let ((a, za), (b, zb)) = (
            world.project(point),
            n.scene_from_world_camera(&world).project(n.scene_from_world(point)),
        );
        assert!((a - b).length() < 1e-9 && (za * 0.25 - zb).abs() < 1e-12);
        let back = n.world_from_scene_camera(&n.scene_from_world_camera(&world));
        assert!((back.translation - world.translation).length() < 1e-12);
        assert!((n.world_from_scene(n.scene_from_world(point)) - point).length() < 1e-12);
    }

    #[test]
    fn if_all_cameras_coincide_the_points_set_the_unit_if_there_are_any() {
        let centre = DVec3::new(1e6, 0.1, 7.0);
        let points: Vec<_> = [2.0, 4.0, 1000.0].iter().map(|&d| centre + DVec3::Y * d).collect();
        assert!((Normalisation::fit(&[centre; 3], &points).scale - 0.25).abs() < 1e-9);
        assert_eq!(Normalisation::fit(&[centre], &[]).scale.to_bits(), 1f64.to_bits());
        assert_eq!(Normalisation::fit(&[centre], &[centre]).scale.to_bits(), 1f64.to_bits());
    }

    #[test]
    fn powers_of_two_change_no_bit_of_the_scene() {
        let centres =
            [DVec3::new(0.3, 1.7, -2.0), DVec3::new(1.1, 0.2, 0.9), DVec3::new(-0.7, 0.4, 0.1)];
        let points = [DVec3::new(0.123, 4.5, -6.7)];
        let scene = |k: i32| {
            let factor = 2f64.powi(k);
            let n = Normalisation::fit(&centres.map(|c| c * factor), &[]);
            (
                n.scene_from_world(points[0] * factor),
                n.scene_from_world_camera(&camera(centres[1] * factor)).translation,
            )
        };
        for k in [-20, -3, 5, 20] {
            assert_eq!(scene(k), scene(0));
        }
    }

    #[test]
    fn models_go_to_the_world_and_back() {
        let model = Gaussians {
            antialiasing: Antialiasing::Wide,
            means: vec![[0.5, -0.25, 1.0]],
            log_scales: vec![[-3.0, -4.0, 0.5]],
            quats: vec![[1.0, 0.0, 0.0, 0.0]],
            opacity_logits: vec![0.3],
            sh: vec![0.1, 0.2, 0.3],
            ..Gaussians::default()
        };
        let n = Normalisation { centre: DVec3::new(100.0, 200.0, 300.0), scale: 0.125 };
        let world = n.world_from_model(model.clone(), [0.0; 3]);
        assert_eq!(world.means, [[104.0, 198.0, 308.0]]);
        assert!((world.log_scales[0][0] - (-3.0 + 8f32.ln())).abs() < 1e-6);
        let local = n.world_from_model(model.clone(), [100.0, 200.0, 300.0]);
        assert_eq!((local.means[0], local.position(0)), ([4.0, -2.0, 8.0], [104.0, 198.0, 308.0]));
        assert_eq!(n.model_from_world(local).means, model.means);
        let back = n.model_from_world(world);
        assert_eq!((&back.means, back.origin), (&model.means, [0.0; 3]));
        assert!((back.log_scales[0][2] - 0.5).abs() < 1e-6);
        assert_eq!((back.quats, back.sh), (model.quats.clone(), model.sh.clone()));
        assert_eq!(Normalisation::IDENTITY.world_from_model(model.clone(), [0.0; 3]), model);
    }
}
