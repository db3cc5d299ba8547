//! Films: renderings along a camera path, as pictures and on request as one MP4 or WebP file.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::str::FromStr;

use densify_core::camera::Camera;
use densify_core::camera_path::{self, CameraPathError, SavedCameraPath};
use densify_core::files::{FileError, one_line, write_atomically};
use densify_core::memory::Bytes;
use densify_data::dataset::normalise::Normalisation;
use densify_render::{Backend, BackendError};
use densify_run::finished::Opened;
use densify_train::pictures::picture;

use crate::animation::{self, Animation};
use crate::pictures::{Channels, PictureFolder};

/// Default number of frames of an orbit or a spiral, and default frames per second.
const FRAMES: u32 = 120;
const FPS: u32 = 30;
/// Memory that rendering takes for each pixel of a frame `[bytes]`.
const BYTES_PER_PIXEL: u64 = 64;

/// A path of cameras through a scene.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum CameraRoute {
    /// Once around the point that the cameras of the dataset look at.
    Orbit,
    /// Two turns in front of the point that the cameras of the dataset look at.
    Spiral,
    /// The path of a file, in the coordinates of the dataset.
    File(PathBuf),
}

impl FromStr for CameraRoute {
    type Err = std::convert::Infallible;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Ok(match text {
            "orbit" => Self::Orbit,
            "spiral" => Self::Spiral,
            file => Self::File(file.into()),
        })
    }
}

/// Options of a film; `None` is replaced by the value in the file of the camera path, or by a default.
#[derive(Debug, Clone, Copy, Default)]
pub struct FilmOptions<'a> {
    /// Number of frames, >= 1.
    pub frames: Option<u32>,
    /// Width and height of a frame `[px]`; by default those of the first photograph.
    pub size: Option<(u32, u32)>,
    /// Frames per second.
    pub fps: Option<u32>,
    /// A file that ends in `.mp4` (needs the program ffmpeg) or `.webp`.
    pub video: Option<&'a Path>,
}

/// The model that is filmed.
pub struct FilmSource {
    /// The renderer with the model.
    pub backend: Box<dyn Backend>,
    /// Spherical-harmonic degree to render at.
    pub sh_degree: u8,
    /// Background colour, sRGB-encoded in `[0, 1]`.
    pub background: [f32; 3],
    /// Transform from the dataset's coordinates to the renderer's.
    pub normalisation: Normalisation,
    /// The dataset's cameras, in the renderer's coordinates; empty if there is only a model.
    pub cameras: Vec<Camera>,
}

impl From<Opened> for FilmSource {
    fn from(opened: Opened) -> Self {
        Self {
            sh_degree: opened.sh_degree,
            background: opened.data.background.fixed(),
            normalisation: opened.dataset.normalisation,
            cameras: opened.dataset.train.iter().map(|view| view.camera).collect(),
            backend: opened.backend,
        }
    }
}

/// An error in making a film.
#[derive(Debug, thiserror::Error)]
pub enum FilmError {
    /// The file of the camera path is invalid.
    #[error("{0}")]
    Path(#[from] CameraPathError),
    /// Neither the file nor a dataset states the size of a frame.
    #[error("the file does not give the size of a frame")]
    NoSize,
    /// A frame of this size does not fit into memory.
    #[error("a frame of {width}x{height} px takes {}, which cannot be allocated", Bytes(*bytes))]
    OutOfMemory {
        /// Width `[px]`.
        width: u32,
        /// Height `[px]`.
        height: u32,
        /// Memory that a frame takes `[bytes]`.
        bytes: u64,
    },
    /// The name of the video has an unknown extension.
    #[error("{path}: name a file that ends in .mp4 or .webp")]
    UnknownFormat {
        /// The video.
        path: PathBuf,
    },
    /// MP4 needs ffmpeg.
    #[error(
        "{path}: this needs the program ffmpeg, which was not found; install it, or name a .webp file"
    )]
    NoFfmpeg {
        /// The video.
        path: PathBuf,
    },
    /// WebP has no frames of this size.
    #[error("{path}: a WebP has at most {} px on each side", animation::MAX_SIDE)]
    TooLargeForWebP {
        /// The video.
        path: PathBuf,
    },
    /// The video could not be made from the pictures.
    #[error("{path}: {problem}; the pictures are in {pictures}")]
    Encoding {
        /// The video.
        path: PathBuf,
        /// The folder of the pictures, which are complete.
        pictures: PathBuf,
        /// The failed step and its error.
        problem: String,
    },
    /// The temporary file of the video could not be written.
    #[error("{path}: cannot write a temporary file for the film: {source}")]
    Temporary {
        /// The video.
        path: PathBuf,
        /// The error of the system.
        source: std::io::Error,
    },
    /// A picture or the video could not be written.
    #[error("{0}")]
    File(#[from] FileError),
    /// Rendering failed.
    #[error("{0}")]
    Backend(#[from] BackendError),
}

/// A finished film.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Film {
    /// Number of frames.
    pub frames: u32,
    /// A note on what the file of the camera path states and is ignored.
    pub note: Option<&'static str>,
}

/// A video that is being made.
enum Video<'a> {
    /// By ffmpeg, from the pictures.
    Mp4(&'a Path),
    WebP(&'a Path, Animation),
}

impl<'a> Video<'a> {
    fn new(path: &'a Path, size: (u32, u32), fps: u32) -> Result<Self, FilmError> {
        let named = || path.to_owned();
        let extension = path.extension().and_then(|extension| extension.to_str());
        match extension.unwrap_or_default().to_ascii_lowercase().as_str() {
            "mp4" => {
                let version = ffmpeg(Path::new("."), &["-version".as_ref()]);
                if version.is_ok_and(|output| output.status.success()) {
                    Ok(Self::Mp4(path))
                } else {
                    Err(FilmError::NoFfmpeg { path: named() })
                }
            }
            "webp" if size.0.max(size.1) > animation::MAX_SIDE => {
                Err(FilmError::TooLargeForWebP { path: named() })
            }
            "webp" => {
                let milliseconds = (1000.0 / f64::from(fps)).round() as u32;
                let animation = Animation::new(size, milliseconds);
                let animation =
                    animation.map_err(|source| FilmError::Temporary { path: named(), source })?;
                Ok(Self::WebP(path, animation))
            }
            _ => Err(FilmError::UnknownFormat { path: named() }),
        }
    }
}

impl Film {
    /// Renders the pictures into `folder`, and the video if one is named.
    ///
    /// # Errors
    /// See [`FilmError`]. Errors in the options are found before the first frame is rendered.
    pub fn make(
        route: &CameraRoute,
        options: FilmOptions<'_>,
        folder: &Path,
        channels: Channels,
        source: FilmSource,
    ) -> Result<Self, FilmError> {
        let FilmSource { mut backend, sh_degree, background, normalisation, cameras } = source;
        let first = cameras.first().map(|first| (first.width, first.height));
        let generated =
            |path| SavedCameraPath { path, frames: FRAMES, fps: None, size: None, note: None };
        let (saved, in_world) = match route {
            CameraRoute::Orbit => (generated(camera_path::orbit(&cameras)), false),
            CameraRoute::Spiral => (generated(camera_path::spiral(&cameras)), false),
            CameraRoute::File(path) => (camera_path::read(path)?, true),
        };
        let frames = options.frames.unwrap_or(saved.frames);
        let fps = options.fps.or(saved.fps).unwrap_or(FPS);
        let size = options.size.or(saved.size).or(first).ok_or(FilmError::NoSize)?;
        check_memory(size)?;
        let mut video = options.video.map(|path| Video::new(path, size, fps)).transpose()?;
        let mut pictures = PictureFolder::new(folder, channels, &normalisation);
        for frame in 0..frames {
            let mut camera = saved.path.frame(frame, frames).camera(size);
            if in_world {
                camera = normalisation.scene_from_world_camera(&camera);
            }
            let rendering = channels.render(backend.as_mut(), &camera, background, sh_degree)?;
            pictures.write(&format!("frame_{frame:05}"), &rendering)?;
            if let Some(Video::WebP(path, animation)) = &mut video {
                animation
                    .add(&picture(&rendering))
                    .map_err(|source| FilmError::Temporary { path: path.to_owned(), source })?;
            }
        }
        pictures.finish()?;
        match video {
            None => {}
            Some(Video::WebP(path, animation)) => animation.write(path)?,
            Some(Video::Mp4(path)) => encode(folder, path, frames, fps)?,
        }
        Ok(Self { frames, note: saved.note })
    }
}

/// Checks that a frame can be allocated, as rendering it would abort the process otherwise.
fn check_memory((width, height): (u32, u32)) -> Result<(), FilmError> {
    let bytes = BYTES_PER_PIXEL * u64::from(width) * u64::from(height);
    let size = usize::try_from(bytes).unwrap_or(usize::MAX);
    Vec::<u8>::new().try_reserve_exact(size).map_err(|_| FilmError::OutOfMemory {
        width,
        height,
        bytes,
    })
}

fn ffmpeg(folder: &Path, arguments: &[&OsStr]) -> std::io::Result<Output> {
    let mut command = Command::new("ffmpeg");
    command.current_dir(folder).args(arguments).stdin(Stdio::null()).stdout(Stdio::null()).output()
}

/// Encodes the first `frames` pictures as a video. The file `path` appears only when it is complete.
fn encode(pictures: &Path, path: &Path, frames: u32, fps: u32) -> Result<(), FilmError> {
    let failed = |problem: String| FilmError::Encoding {
        path: path.to_owned(),
        pictures: pictures.to_owned(),
        problem,
    };
    let film = tempfile::Builder::new().suffix(".mp4").tempfile();
    let mut film = film.map_err(|e| failed(format!("cannot create a temporary file: {e}")))?;
    let (rate, count) = (fps.to_string(), frames.to_string());
    // The pictures are named relative to their folder, because a % in its path would be part of the pattern.
    let input = ["-framerate", &rate, "-start_number", "0", "-i", "frame_%05d.png"];
    // yuv420p halves the resolution of colour each way, so sides must be even.
    let even = "pad=ceil(iw/2)*2:ceil(ih/2)*2";
    // The number of frames is given because the folder may also hold pictures of an earlier, longer film.
    let output =
        ["-frames:v", &count, "-vf", even, "-pix_fmt", "yuv420p", "-movflags", "+faststart"];
    let words = ["-y", "-loglevel", "error"].into_iter().chain(input).chain(output);
    let arguments: Vec<&OsStr> = words.map(OsStr::new).chain([film.path().as_os_str()]).collect();
    match ffmpeg(pictures, &arguments) {
        Ok(Output { status, .. }) if status.success() => {}
        Ok(Output { status, stderr, .. }) => {
            let output = String::from_utf8_lossy(&stderr);
            let last = output.lines().rfind(|line| !line.trim().is_empty()).unwrap_or_default();
            return Err(failed(format!("ffmpeg ended with {status}: {}", one_line(last))));
        }
        Err(e) => return Err(failed(format!("ffmpeg: {e}"))),
    }
    write_atomically(path, |out| std::io::copy(&mut film, out).map(|_| ()))?;
    Ok(())
}
