//! Camera placement.
//!
//! Training and test views follow different paths. Except for a file's own cameras, no camera is inside a solid
//! or closer to a surface than [`Rig::clearance`] allows, as a view from inside a wall is useless as ground truth.

mod survey;

use std::f64::consts::TAU;

use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};

use crate::camera::Camera;
use crate::error::Error;
use crate::mesh::FileCamera;
use crate::random::Draws;
use crate::surface::Surface;
pub use survey::Survey;

/// A kind of camera arrangement.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RigKind {
    /// On rings around the scene, looking at its centre.
    Orbit,
    /// On a Fibonacci lattice over the upper hemisphere, looking at the centre.
    Dome,
    /// Inside the scene, looking in all directions, for rooms.
    Inside,
    /// On an ellipse as wide and deep as the scene, looking at the centre.
    Ellipse,
    /// In rows above the scene, looking obliquely down, and along its streets, if it has any.
    Survey,
    /// At and around the file's own cameras.
    File,
}

/// A camera arrangement with all its parameters.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Rig {
    /// Kind of arrangement.
    pub kind: RigKind,
    /// Number of training views.
    pub train: u32,
    /// Number of test views, which are held out.
    pub test: u32,
    /// Image width `[px]`.
    pub width: u32,
    /// Image height `[px]`.
    pub height: u32,
    /// Horizontal field of view `[degrees]`.
    pub fov: f64,
    /// Distance from the centre, in multiples of the distance at which the scene's bounding sphere fills the
    /// image. For `Inside`, the path's radius as a share of half the room; for `Survey`, a factor on the cameras'
    /// height.
    pub radius: f64,
    /// Lowest and highest elevation of the cameras `[degrees]`.
    pub elevation: [f64; 2],
    /// Range of azimuths, centred on +z `[degrees]`.
    pub arc: f64,
    /// Standard deviation of random shifts of the cameras, as a share of the distance to the point looked at.
    pub jitter: f64,
    /// Smallest distance from any surface, as a share of the geometry's diagonal.
    pub clearance: f64,
    /// The point that the cameras look at; by default the centre of the bounding box.
    pub target: Option<[f64; 3]>,
    /// Radius around the target that fills the image; by default that of the bounding sphere.
    pub focus: Option<f64>,
    /// Seed of the jitter.
    pub seed: u64,
    /// Area and streets of a survey; by default it covers the bounding box.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub survey: Option<Survey>,
}

impl Default for Rig {
    fn default() -> Self {
        Self {
            kind: RigKind::Dome,
            train: 60,
            test: 20,
            width: 256,
            height: 256,
            fov: 50.0,
            radius: 1.0,
            elevation: [5.0, 75.0],
            arc: 360.0,
            jitter: 0.0,
            clearance: 0.005,
            target: None,
            focus: None,
            seed: 0,
            survey: None,
        }
    }
}

/// The golden angle `[rad]`.
const GOLDEN: f64 = TAU * 0.381_966_011_250_105;
/// Number of positions tried for a camera before giving up.
const ATTEMPTS: u64 = 200;

/// A camera position, and the point that the camera looks at.
type Viewpoint = (DVec3, DVec3);

impl Rig {
    /// The cameras of training and test views.
    ///
    /// # Errors
    /// When an option is out of range, the file has no camera to start from, or no position outside the
    /// geometry is found.
    pub fn cameras(
        &self,
        surface: &Surface,
        file: &[FileCamera],
    ) -> Result<(Vec<Camera>, Vec<Camera>), Error> {
        self.check()?;
        if self.kind == RigKind::File && file.is_empty() {
            let problem =
                "the file has no perspective camera; choose orbit, dome, ellipse, inside or survey";
            return Err(Error::option("--rig", problem));
        }
        let split = |test: bool| {
            let count = if test { self.test } else { self.train };
            (0..count).map(|i| self.camera(surface, file, i, test)).collect::<Result<Vec<_>, _>>()
        };
        Ok((split(false)?, split(true)?))
    }

    fn check(&self) -> Result<(), Error> {
        for side in [self.width, self.height] {
            if !(1..=16_384).contains(&side) {
                return Err(Error::option("--size", format!("{side} is not between 1 and 16384")));
            }
        }
        if u64::from(self.width) * u64::from(self.height) > 1 << 28 {
            return Err(Error::option("--size", "an image may have at most 2^28 pixels"));
        }
        for (option, min, count) in [("--train", 1, self.train), ("--test", 0, self.test)] {
            if !(min..=100_000).contains(&count) {
                let problem = format!("{count} is not between {min} and 100000");
                return Err(Error::option(option, problem));
            }
        }
        if !(self.fov > 0.5 && self.fov < 170.0) {
            let problem = format!("{} degrees is not between 0.5 and 170", self.fov);
            return Err(Error::option("--fov", problem));
        }
        if !(self.radius > 0.0 && self.radius <= 1e3) {
            let problem = format!("{} is not above 0 and at most 1000", self.radius);
            return Err(Error::option("--radius", problem));
        }
        if !(self.jitter >= 0.0 && self.jitter <= 0.5) {
            let problem = format!("{} is not between 0 and 0.5", self.jitter);
            return Err(Error::option("--jitter", problem));
        }
        Ok(())
    }

    fn camera(
        &self,
        surface: &Surface,
        file: &[FileCamera],
        i: u32,
        test: bool,
    ) -> Result<Camera, Error> {
        let mut draws = Draws::new(self.seed, &[u64::from(i), u64::from(test)]);
        for attempt in 0..ATTEMPTS {
            if self.kind == RigKind::File && attempt == 0 && !test && (i as usize) < file.len() {
                // The file's author chose this position, so it is not tested.
                return Ok(self.file_camera(&file[i as usize]));
            }
            let (place, target) = self.viewpoint(surface, file, (i, test), attempt);
            let reach = (place - target).length();
            // The requested jitter first, then more at each attempt.
            let spread = self.jitter.max(0.005 * attempt as f64) * reach;
            let mut shift = || DVec3::new(draws.normal(), draws.normal(), draws.normal());
            let offset = if spread > 0.0 { shift() * spread } else { DVec3::ZERO };
            let place = place + offset;
            if !self.is_free(surface, place) {
                continue;
            }
            let camera = self.looking(place, target, file, i);
            if self.kind != RigKind::Survey || survey::shows_enough(surface, &camera, attempt) {
                return Ok(camera);
            }
        }
        Err(Error::Input(format!(
            "view {i}: found no camera position outside the geometry; choose another --rig or a larger \
             --radius"
        )))
    }

    fn size(&self) -> (u32, u32) {
        (self.width, self.height)
    }

    fn looking(&self, place: DVec3, target: DVec3, file: &[FileCamera], i: u32) -> Camera {
        let camera = Camera::looking(place, target, DVec3::Y, self.fov.to_radians(), self.size());
        if self.kind != RigKind::File {
            return camera;
        }
        let like = self.file_camera(&file[i as usize % file.len()]);
        let up = -like.world_from_camera.y_axis;
        let turned = Camera::looking(place, target, up, self.fov.to_radians(), self.size());
        Camera { fx: like.fx, fy: like.fy, ..turned }
    }

    fn file_camera(&self, file: &FileCamera) -> Camera {
        let focal = 0.5 * f64::from(self.height) / (0.5 * file.yfov).tan();
        Camera::centred(self.size(), focal, file.world_from_camera, file.centre)
    }

    /// The viewpoint of a view, given by its index within its split, before jitter.
    fn viewpoint(
        &self,
        surface: &Surface,
        file: &[FileCamera],
        (number, test): (u32, bool),
        attempt: u64,
    ) -> Viewpoint {
        let (lo, hi) = surface.bounds();
        let middle = self.target.map_or(0.5 * (lo + hi), DVec3::from);
        let half = 0.5 * (hi - lo);
        let fill = self.focus.unwrap_or(half.length()).max(f64::MIN_POSITIVE);
        let fov_x = self.fov.to_radians();
        let fov_y =
            2.0 * ((0.5 * fov_x).tan() * f64::from(self.height) / f64::from(self.width)).atan();
        let distance = self.radius * fill / (0.5 * fov_x.min(fov_y)).sin();
        let count = f64::from(if test { self.test } else { self.train });
        let (i, low, high) =
            (f64::from(number), self.elevation[0].to_radians(), self.elevation[1].to_radians());
        // Test views are shifted by half a step, so that they lie between training views.
        let shift = if test { 0.5 } else { 0.0 };
        let along = |share: f64| self.arc.to_radians() * (share - 0.5);
        match self.kind {
            RigKind::Orbit => {
                let azimuth = along((i + 0.25 + shift) / count);
                let share = if test { 0.5 } else { (i * 0.618_033_988_749_895).fract() };
                (middle + distance * on_sphere(azimuth, low + share * (high - low)), middle)
            }
            RigKind::Dome => {
                let share = (i + 0.5) / count;
                let elevation = (low.sin() + share * (high.sin() - low.sin())).asin();
                let turn = ((i + shift) * GOLDEN + shift).rem_euclid(TAU) / TAU;
                (middle + distance * on_sphere(along(turn), elevation), middle)
            }
            RigKind::Ellipse => {
                let azimuth = along((i + shift) / count);
                let wide = half.length() / half.x.hypot(half.z).max(f64::MIN_POSITIVE);
                let scale = distance / half.length().max(f64::MIN_POSITIVE) * wide;
                let scale = if test { 0.93 * scale } else { scale };
                let elevation = low + (0.5 - 0.5 * (2.0 * azimuth).cos()) * (high - low);
                let flat = on_sphere(azimuth, 0.0) * DVec3::new(half.x, 0.0, half.z) * scale;
                let up = flat.length() * elevation.tan();
                (middle + flat + DVec3::Y * up, middle)
            }
            RigKind::Inside => {
                let ring = if test { 0.6 * self.radius } else { self.radius };
                let azimuth = TAU * (i + shift) / count;
                let height = 0.3 * ((i * 0.618_033_988_749_895 + shift).fract() - 0.5);
                let place = middle + (on_sphere(azimuth, 0.0) * ring + DVec3::Y * height) * half;
                // The camera looks outwards or across the room, in every direction in turn.
                let yaw = i * GOLDEN + shift;
                let pitch = low + (i * 0.754_877_666_246_693 + shift).fract() * (high - low);
                (place, place + on_sphere(yaw, pitch) * half.length())
            }
            RigKind::Survey => self.survey_viewpoint(surface, (number, test), attempt),
            RigKind::File => {
                let camera = &file[number as usize % file.len()];
                let forward = camera.world_from_camera.z_axis;
                let met = surface.cast(camera.centre, forward, f64::INFINITY);
                let focus = met.map_or(half.length(), |hit| hit.t);
                let round = 1.0 + (i / file.len() as f64).floor();
                let angle = i * GOLDEN + 2.0 * shift;
                let reach = 0.12 * focus * (round / (1.0 + count / file.len() as f64)).sqrt();
                let m: &DMat3 = &camera.world_from_camera;
                let offset = reach * (angle.cos() * m.x_axis + angle.sin() * m.y_axis);
                (camera.centre + offset, camera.centre + forward * focus)
            }
        }
    }

    /// True if a camera may be placed here.
    fn is_free(&self, surface: &Surface, place: DVec3) -> bool {
        let (lo, hi) = surface.bounds();
        let outside = (lo - place).max(place - hi).max_element();
        let clearance = self.clearance * surface.diagonal();
        if outside > clearance {
            return true;
        }
        surface.nearest(place).distance >= clearance && !is_inside(surface, place)
    }
}

/// True if a point is inside a solid: most surfaces seen from it show their backs.
fn is_inside(surface: &Surface, place: DVec3) -> bool {
    const RAYS: i32 = 26;
    let (mut fronts, mut backs) = (0, 0);
    for i in 0..RAYS {
        let height = (2.0 * f64::from(i) + 1.0) / f64::from(RAYS) - 1.0;
        let direction = on_sphere(f64::from(i) * GOLDEN, height.asin());
        match surface.cast(place, direction, f64::INFINITY) {
            Some(hit) if hit.front => fronts += 1,
            Some(_) => backs += 1,
            None => {}
        }
    }
    backs > fronts
}

/// The unit vector at an azimuth about +y, starting at +z, and an elevation `[rad]`.
fn on_sphere(azimuth: f64, elevation: f64) -> DVec3 {
    let flat = elevation.cos();
    DVec3::new(flat * azimuth.sin(), elevation.sin(), flat * azimuth.cos())
}
