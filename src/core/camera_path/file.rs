//! Camera paths as files: nerfstudio's JSON, as its viewer saves it.

use std::path::{Path, PathBuf};

use glam::{DMat3, DMat4, DQuat, DVec3};
use serde::Deserialize;

use super::{Flight, Key};
use crate::files;

/// Most bytes of a file.
const MOST_BYTES: u64 = 64 << 20;
/// Most cameras, and most frames, of a path.
const MOST_KEYS: usize = 100_000;
/// Longest side of a frame `[px]`.
pub const MOST_SIDE: u32 = 16_384;

/// Why a camera path cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum FlightError {
    /// The file cannot be read.
    #[error("{}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: std::io::Error,
    },
    /// It is no camera path.
    #[error("{}: {problem}", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// What is wrong, and the remedy.
        problem: String,
    },
}

/// A camera path of a file.
#[derive(Debug, Clone, PartialEq)]
pub struct SavedFlight {
    /// The path, in the coordinates of the dataset.
    pub flight: Flight,
    /// How many frames it has, >= 1: as long as it lasts at its rate, or one for each camera.
    pub frames: u32,
    /// Frames per second, 1 to 1000, if it says so.
    pub fps: Option<u32>,
    /// Width and height of a frame `[px]`, if it says so.
    pub size: Option<(u32, u32)>,
}

/// The parts of the file that say where cameras are and what is made of them.
#[derive(Deserialize)]
struct Saved {
    camera_path: Vec<SavedKey>,
    camera_type: Option<String>,
    #[serde(default)]
    is_cycle: bool,
    seconds: Option<f64>,
    fps: Option<f64>,
    render_width: Option<f64>,
    render_height: Option<f64>,
}

#[derive(Deserialize)]
struct SavedKey {
    /// Row-major, 4×4; the camera's axes are x right, y up, z backward.
    camera_to_world: Vec<f64>,
    /// Vertical field of view `[°]`.
    fov: f64,
}

/// Reads a camera path.
///
/// # Errors
/// When the file cannot be read, is longer than 64 MiB, or is no path of 1 to 100,000 perspective cameras with
/// finite poses and fields of view between 0 and 180 degrees, of 1 to 100,000 frames.
pub fn read(path: &Path) -> Result<SavedFlight, FlightError> {
    let io = |source| FlightError::Read { path: path.to_owned(), source };
    let text = files::read_text(path, MOST_BYTES).map_err(io)?;
    parse(&text).map_err(|problem| FlightError::Malformed { path: path.to_owned(), problem })
}

pub fn parse(text: &str) -> Result<SavedFlight, String> {
    let saved: Saved = serde_json::from_str(text)
        .map_err(|e| format!("it is no camera path of nerfstudio ({e}); save one in its viewer"))?;
    if let Some(kind) = saved.camera_type.filter(|kind| !kind.eq_ignore_ascii_case("perspective")) {
        return Err(format!("camera_type is {kind:?}; only perspective cameras can be rendered"));
    }
    let count = saved.camera_path.len();
    if count == 0 || count > MOST_KEYS {
        return Err(format!("camera_path has {count} cameras; 1 to {MOST_KEYS} are possible"));
    }
    let keys = saved.camera_path.iter().enumerate().map(|(at, saved)| {
        key(&saved.camera_to_world, saved.fov)
            .map_err(|problem| format!("camera {at} of camera_path: {problem}"))
    });
    let flight = Flight { keys: keys.collect::<Result<_, String>>()?, is_loop: saved.is_cycle };
    let bounded = |name: &str, value: Option<f64>, most: f64| match value {
        Some(value) if !(value > 0.0 && value <= most) => {
            Err(format!("{name} is {value}; it must be above 0, and {most} at most"))
        }
        value => Ok(value),
    };
    let frames = bounded("fps", saved.fps, 1000.0)?
        .zip(bounded("seconds", saved.seconds, f64::MAX)?)
        .map(|(fps, seconds)| (fps * seconds).round().max(1.0));
    let frames = bounded("seconds times fps", frames, MOST_KEYS as f64)?.unwrap_or(count as f64);
    let side = |name, value| bounded(name, value, f64::from(MOST_SIDE));
    let size = side("render_width", saved.render_width)?
        .zip(side("render_height", saved.render_height)?)
        .map(|(width, height)| (width.ceil() as u32, height.ceil() as u32));
    let fps = saved.fps.map(|fps| fps.round().max(1.0) as u32);
    Ok(SavedFlight { flight, frames: frames as u32, fps, size })
}

/// A camera of a path: `camera_to_world` row after row, 4×4, with axes right, up and backward; `fov` in degrees.
///
/// # Errors
/// When the pose is not finite or not a pose, or the field of view is not between 0 and 180 degrees.
pub fn key(numbers: &[f64], fov: f64) -> Result<Key, String> {
    let Ok(rows) = <[f64; 16]>::try_from(numbers) else {
        return Err(format!("camera_to_world has {} numbers, not 16", numbers.len()));
    };
    if rows.iter().any(|number| !number.is_finite()) {
        return Err("camera_to_world is not finite".to_owned());
    }
    if !(fov > 0.0 && fov < 180.0) {
        return Err(format!("fov is {fov}; it must be between 0 and 180 degrees"));
    }
    let pose = DMat4::from_cols_array(&rows).transpose();
    let axes = DMat3::from_mat4(pose);
    let lengths = [axes.x_axis, axes.y_axis, axes.z_axis].map(DVec3::length);
    let volume = axes.determinant();
    let is_turn =
        volume > 0.0 && (volume / (lengths[0] * lengths[1] * lengths[2]) - 1.0).abs() < 1e-2;
    if !is_turn {
        return Err("camera_to_world does not turn its axes, but bends or mirrors them".to_owned());
    }
    // y and z point the other way here.
    let axes = DMat3::from_cols(axes.x_axis, -axes.y_axis, -axes.z_axis);
    let x = axes.x_axis.normalize();
    let z = (axes.z_axis - x * axes.z_axis.dot(x)).normalize();
    let turn = DQuat::from_mat3(&DMat3::from_cols(x, z.cross(x), z));
    Ok(Key { centre: pose.w_axis.truncate(), turn, fov_y: fov.to_radians() })
}
