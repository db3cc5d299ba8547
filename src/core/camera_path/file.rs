//! Reads camera paths in nerfstudio's JSON format, as its viewer saves them.

use std::path::{Path, PathBuf};

use glam::{DMat3, DMat4, DQuat, DVec3};
use serde::Deserialize;
use serde::de::IgnoredAny;

use super::{CameraPath, Keyframe};
use crate::camera::Camera;
use crate::files;

/// Maximum size of a file `[bytes]`.
const MAX_BYTES: u64 = 64 << 20;
/// Maximum number of keyframes of a path, and maximum number of frames.
const MAX_KEYFRAMES: usize = 100_000;
/// Width and height of frames if the file gives none `[px]`; only the poses and the aspect ratio matter then.
const DEFAULT_SIZE: (u32, u32) = (1600, 900);
/// Maximum width and height of a frame `[px]`.
pub const MAX_SIDE: u32 = 16_384;

/// Errors of reading a camera path.
#[derive(Debug, thiserror::Error)]
pub enum CameraPathError {
    /// The file cannot be read.
    #[error("{}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// The file is not a camera path that densify can use.
    #[error("{}: {problem}", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// The problem and its remedy.
        problem: String,
    },
}

/// A camera path from a file.
#[derive(Debug, Clone, PartialEq)]
pub struct SavedCameraPath {
    /// The path, in the coordinates of the dataset.
    pub path: CameraPath,
    /// Number of frames, >= 1: duration times frame rate if the file has both, otherwise one per keyframe.
    pub frames: u32,
    /// Frames per second, 1 to 1000, if given.
    pub fps: Option<u32>,
    /// Width and height of a frame `[px]`, if given.
    pub size: Option<(u32, u32)>,
    /// A note on what the file states and is ignored.
    pub note: Option<&'static str>,
}

impl SavedCameraPath {
    /// The cameras of all frames, with images of the path's size, or of an arbitrary size if it has none.
    pub fn cameras(&self) -> Vec<Camera> {
        let size = self.size.unwrap_or(DEFAULT_SIZE);
        (0..self.frames).map(|frame| self.path.frame(frame, self.frames).camera(size)).collect()
    }
}

/// The fields of the file that are used.
#[derive(Deserialize)]
struct SavedFile {
    camera_path: Vec<SavedKeyframe>,
    camera_type: Option<String>,
    #[serde(default)]
    is_cycle: bool,
    seconds: Option<f64>,
    fps: Option<f64>,
    render_width: Option<f64>,
    render_height: Option<f64>,
    crop: Option<IgnoredAny>,
}

#[derive(Deserialize)]
struct SavedKeyframe {
    /// Row-major, 4×4; the camera's axes are x right, y up, z backward.
    camera_to_world: Vec<f64>,
    /// Vertical field of view `[°]`.
    fov: f64,
}

/// Reads a camera path.
///
/// # Errors
/// When the file cannot be read, is larger than 64 MiB, or is not a path of 1 to 100,000 frames through 1 to 100,000
/// perspective cameras with finite poses and fields of view between 0 and 180 degrees.
pub fn read(path: &Path) -> Result<SavedCameraPath, CameraPathError> {
    let io = |source| CameraPathError::Read { path: path.to_owned(), source };
    let text = files::read_text(path, MAX_BYTES).map_err(io)?;
    parse(&text).map_err(|problem| CameraPathError::Malformed { path: path.to_owned(), problem })
}

pub(super) fn parse(text: &str) -> Result<SavedCameraPath, String> {
    let saved: SavedFile = serde_json::from_str(text)
        .map_err(|e| format!("it is not a nerfstudio camera path ({e}); save one in its viewer"))?;
    if let Some(kind) = saved.camera_type.filter(|kind| !kind.eq_ignore_ascii_case("perspective")) {
        return Err(format!("camera_type is {kind:?}; only perspective cameras can be rendered"));
    }
    let count = saved.camera_path.len();
    if count == 0 || count > MAX_KEYFRAMES {
        return Err(format!("camera_path has {count} cameras; it must have 1 to {MAX_KEYFRAMES}"));
    }
    let keyframes = saved.camera_path.iter().enumerate().map(|(index, saved)| {
        parse_keyframe(&saved.camera_to_world, saved.fov)
            .map_err(|problem| format!("camera {index} of camera_path: {problem}"))
    });
    let keyframes = keyframes.collect::<Result<_, String>>()?;
    let path = CameraPath { keyframes, is_loop: saved.is_cycle };
    let bounded = |name: &str, value: Option<f64>, max: f64| match value {
        Some(value) if !(value > 0.0 && value <= max) => {
            Err(format!("{name} is {value}; it must be above 0 and at most {max}"))
        }
        value => Ok(value),
    };
    let frames = bounded("fps", saved.fps, 1000.0)?
        .zip(bounded("seconds", saved.seconds, f64::MAX)?)
        .map(|(fps, seconds)| (fps * seconds).round().max(1.0));
    let frames =
        bounded("seconds times fps", frames, MAX_KEYFRAMES as f64)?.unwrap_or(count as f64);
    let side = |name, value| bounded(name, value, f64::from(MAX_SIDE));
    let size = side("render_width", saved.render_width)?
        .zip(side("render_height", saved.render_height)?)
        .map(|(width, height)| (width.ceil() as u32, height.ceil() as u32));
    let fps = saved.fps.map(|fps| fps.round().max(1.0) as u32);
    let note = saved.crop.map(|_| "its crop is ignored: the whole model is shown");
    Ok(SavedCameraPath { path, frames: frames as u32, fps, size, note })
}

/// Parses a keyframe. `numbers` is camera_to_world, 4×4 and row-major, with axes right, up and backward; `fov` is the
/// vertical field of view in degrees.
///
/// # Errors
/// When the matrix is not finite or not a rigid pose, or the field of view is not between 0 and 180 degrees.
pub fn parse_keyframe(numbers: &[f64], fov: f64) -> Result<Keyframe, String> {
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
    let is_rotation =
        volume > 0.0 && (volume / (lengths[0] * lengths[1] * lengths[2]) - 1.0).abs() < 1e-2;
    if !is_rotation {
        return Err("camera_to_world is not a rotation: it shears or mirrors the axes".to_owned());
    }
    // OpenCV's y and z axes point the other way.
    let axes = DMat3::from_cols(axes.x_axis, -axes.y_axis, -axes.z_axis);
    let x = axes.x_axis.normalize();
    let z = (axes.z_axis - x * axes.z_axis.dot(x)).normalize();
    let world_from_camera = DQuat::from_mat3(&DMat3::from_cols(x, z.cross(x), z));
    Ok(Keyframe { centre: pose.w_axis.truncate(), world_from_camera, fov_y: fov.to_radians() })
}
