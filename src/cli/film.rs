//! `densify render --path`: a flight through the scene, as pictures and as a film.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::str::FromStr;

use clap::Args;

use super::console::Console;
use super::render::{Extras, write_pictures};
use crate::animation::{self, Animation};
use crate::camera::Camera;
use crate::failure::{Failure, OTHER};
use crate::flight;
use crate::pictures::picture;
use crate::run::finished::Opened;

/// Most frames of a flight.
const MOST_FRAMES: u32 = 100_000;
/// Longest side of a frame `[px]`.
const MAX_SIDE: u32 = 16_384;
/// Frames of a flight of its own.
const FRAMES: u32 = 120;

/// Options of a flight.
#[derive(Debug, Args)]
#[command(next_help_heading = "Flight")]
pub(super) struct FilmArgs {
    /// Render a flight instead of the dataset's views: orbit (once around what the cameras look at),
    /// spiral (two turns before it), or a camera path of nerfstudio's viewer (JSON), in the
    /// dataset's coordinates
    #[arg(long, value_name = "orbit|spiral|FILE")]
    pub(super) path: Option<Route>,
    /// Number of frames `[default: 120; of a file, as many as it has cameras]`
    #[arg(long, value_name = "N", requires = "path", value_parser = clap::value_parser!(u32).range(1..=i64::from(MOST_FRAMES)))]
    frames: Option<u32>,
    /// Width and height of the frames, such as 640x480 `[default: those of the first photograph]`
    #[arg(long, value_name = "WxH", requires = "path")]
    size: Option<Size>,
    /// Frames per second of the film
    #[arg(long, value_name = "N", requires = "video", default_value_t = 30, value_parser = clap::value_parser!(u32).range(1..=1000))]
    fps: u32,
    /// Also write a film: .mp4 (needs the program ffmpeg) or .webp (lossless, by densify itself)
    #[arg(long, value_name = "FILE", requires = "path")]
    video: Option<PathBuf>,
}

/// Where a flight goes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Route {
    Orbit,
    Spiral,
    File(PathBuf),
}

impl FromStr for Route {
    type Err = std::convert::Infallible;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Ok(match text {
            "orbit" => Self::Orbit,
            "spiral" => Self::Spiral,
            file => Self::File(file.into()),
        })
    }
}

/// Width and height `[px]`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Size(u32, u32);

impl FromStr for Size {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let sides = text.split_once('x').map(|(width, height)| [width, height].map(str::parse));
        match sides {
            Some([Ok(width), Ok(height)])
                if [width, height].iter().all(|side| (1..=MAX_SIDE).contains(side)) =>
            {
                Ok(Self(width, height))
            }
            _ => Err(format!("give WIDTHxHEIGHT, such as 640x480, each from 1 to {MAX_SIDE}")),
        }
    }
}

/// What a film is written as.
enum Film<'a> {
    /// By ffmpeg, from the pictures.
    Mp4(&'a Path),
    WebP(&'a Path, Animation),
}

impl<'a> Film<'a> {
    fn new(path: &'a Path, size: (u32, u32), fps: u32) -> Result<Self, Failure> {
        let ending = path.extension().and_then(|ending| ending.to_str()).unwrap_or_default();
        match ending.to_ascii_lowercase().as_str() {
            "mp4" => {
                if !ffmpeg(&["-version".as_ref()]).is_ok_and(|status| status.success()) {
                    return Err(Failure::input(format!(
                        "--video {}: the program ffmpeg is needed for it and was not found; install it, \
                         or name a .webp",
                        path.display()
                    )));
                }
                Ok(Self::Mp4(path))
            }
            "webp" if size.0.max(size.1) > animation::MAX_SIDE => Err(Failure::input(format!(
                "--video {}: sides of WebP have at most {} px; give a smaller --size",
                path.display(),
                animation::MAX_SIDE
            ))),
            "webp" => {
                let milliseconds = (1000.0 / f64::from(fps)).round() as u32;
                let animation = Animation::new(size, milliseconds).map_err(|e| Failure {
                    code: OTHER,
                    message: format!("a temporary file for the film: {e}"),
                })?;
                Ok(Self::WebP(path, animation))
            }
            _ => Err(Failure::input(format!(
                "--video {}: name a file that ends in .mp4 or .webp",
                path.display()
            ))),
        }
    }
}

/// Renders the flight.
pub(super) fn run(
    args: &FilmArgs,
    route: &Route,
    output: &Path,
    extras: Extras,
    opened: &mut Opened,
    console: &Console,
) -> Result<(), Failure> {
    let dataset = &opened.dataset;
    let cameras: Vec<Camera> = dataset.train.iter().map(|view| view.camera).collect();
    let Some(first) = cameras.first() else {
        return Err(Failure::input("--path: the dataset has no camera to take it from"));
    };
    let size = args.size.map_or((first.width, first.height), |Size(width, height)| (width, height));
    let (flight, in_world) = match route {
        Route::Orbit => (flight::orbit(&cameras), false),
        Route::Spiral => (flight::spiral(&cameras), false),
        Route::File(path) => {
            (flight::read(path).map_err(|e| Failure::input(format!("--path: {e}")))?, true)
        }
    };
    let frames = args.frames.unwrap_or(match route {
        Route::File(_) => flight.keys.len() as u32,
        Route::Orbit | Route::Spiral => FRAMES,
    });
    let mut film = args.video.as_deref().map(|path| Film::new(path, size, args.fps)).transpose()?;
    let background = opened.data.background.fixed();
    let mut depths = extras.depths(&dataset.normalisation);
    for frame in 0..frames {
        let camera = flight.frame(frame, frames).camera(size);
        let camera = match in_world {
            true => opened.dataset.normalisation.scene_from_world_camera(&camera),
            false => camera,
        };
        let rendering = opened.backend.render(&camera, background, opened.sh_degree)?;
        let name = format!("frame_{frame:05}");
        write_pictures(output, &name, &rendering, extras, &mut depths)?;
        if let Some(Film::WebP(path, animation)) = &mut film {
            animation.add(&picture(&rendering)).map_err(|e| Failure {
                code: OTHER,
                message: format!("{}: {e}", path.display()),
            })?;
        }
    }
    depths.write(output)?;
    console.result(format_args!("{frames} frames in {}", output.display()));
    match film {
        None => return Ok(()),
        Some(Film::WebP(path, animation)) => animation.write(path)?,
        Some(Film::Mp4(path)) => encode(output, path, args.fps)?,
    }
    let path = args.video.as_deref().unwrap_or(output);
    console.result(format_args!("film in {}", path.display()));
    Ok(())
}

fn ffmpeg(arguments: &[&std::ffi::OsStr]) -> std::io::Result<std::process::ExitStatus> {
    let quiet = Stdio::null;
    Command::new("ffmpeg").args(arguments).stdin(quiet()).stdout(quiet()).stderr(quiet()).status()
}

/// Makes a film of the pictures. It has its name only when it is whole.
fn encode(pictures: &Path, path: &Path, fps: u32) -> Result<(), Failure> {
    let failed = |problem: String| Failure {
        code: OTHER,
        message: format!(
            "{}: {problem}; the pictures are in {}",
            path.display(),
            pictures.display()
        ),
    };
    let folder = match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    std::fs::create_dir_all(folder).map_err(|e| failed(e.to_string()))?;
    let unfinished = tempfile::Builder::new()
        .prefix(".densify-")
        .suffix(".mp4")
        .tempfile_in(folder)
        .map_err(|e| failed(e.to_string()))?
        .into_temp_path();
    let (rate, input) = (fps.to_string(), pictures.join("frame_%05d.png"));
    let words = ["-y", "-loglevel", "error", "-framerate", &rate, "-i"].map(std::ffi::OsStr::new);
    // Its colours are halved each way, so sides must be even.
    let even = "pad=ceil(iw/2)*2:ceil(ih/2)*2";
    let more =
        ["-vf", even, "-pix_fmt", "yuv420p", "-movflags", "+faststart"].map(std::ffi::OsStr::new);
    let arguments =
        [&words[..], &[input.as_os_str()], &more[..], &[unfinished.as_os_str()]].concat();
    match ffmpeg(&arguments) {
        Ok(status) if status.success() => {
            unfinished.persist(path).map_err(|e| failed(e.error.to_string()))
        }
        Ok(status) => Err(failed(format!("ffmpeg ended with {status}"))),
        Err(e) => Err(failed(format!("ffmpeg: {e}"))),
    }
}
