//! `densify render --path`: a flight through the scene, as pictures and as a film.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::str::FromStr;

use clap::Args;

use super::console::Console;
use super::render::{Extras, write_pictures};
use crate::animation::{self, Animation};
use densify_core::camera::Camera;
use densify_core::camera_path;
use densify_core::camera_path::SavedFlight;
use densify_core::files::one_line;
use densify_core::files::write_atomically;
use densify_core::memory::Bytes;
use densify_data::dataset::normalise::Normalisation;
use densify_render::Backend;
use densify_run::failure::{DEVICE, Failure, OTHER};
use densify_run::finished::Opened;
use densify_train::pictures::picture;

/// Most frames of a flight.
const MOST_FRAMES: u32 = 100_000;
/// Frames of a flight of its own, and how many of them pass in a second.
const FRAMES: u32 = 120;
const FPS: u32 = 30;
/// What rendering takes for each pixel of a frame `[bytes]`.
const PIXEL: u64 = 64;

/// Options of a flight.
#[derive(Debug, Args)]
#[command(next_help_heading = "Flight")]
pub(super) struct FilmArgs {
    /// Render a flight instead of the dataset's views: orbit (once around what the cameras look at),
    /// spiral (two turns before it), or a camera path as the page of `densify view` or nerfstudio's
    /// viewer saves it (JSON). It must be in the dataset's coordinates, as the page's are; nerfstudio's
    /// are where it trained with `--orientation-method none --center-method none --auto-scale-poses False`
    #[arg(long, value_name = "orbit|spiral|FILE")]
    pub(super) path: Option<Route>,
    /// Number of frames `[default: 120; of a file, its seconds times its fps, else one for each camera]`
    #[arg(long, value_name = "N", requires = "path", value_parser = clap::value_parser!(u32).range(1..=i64::from(MOST_FRAMES)))]
    frames: Option<u32>,
    /// Width and height of the frames, such as 640x480 `[default: those of the file, else of the first photograph]`
    #[arg(long, value_name = "WxH", requires = "path")]
    size: Option<Size>,
    /// Frames per second of the film `[default: those of the file, else 30]`
    #[arg(long, value_name = "N", requires = "video", value_parser = clap::value_parser!(u32).range(1..=1000))]
    fps: Option<u32>,
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
                if [width, height]
                    .iter()
                    .all(|side| (1..=camera_path::MOST_SIDE).contains(side)) =>
            {
                Ok(Self(width, height))
            }
            _ => Err(format!(
                "give WIDTHxHEIGHT, such as 640x480, each from 1 to {}",
                camera_path::MOST_SIDE
            )),
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
                if !ffmpeg(Path::new("."), &["-version".as_ref()])
                    .is_ok_and(|it| it.status.success())
                {
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
                let animation = Animation::new(size, milliseconds).map_err(|e| {
                    Failure::new(OTHER, format!("a temporary file for the film: {e}"))
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

/// What is filmed.
pub(super) struct Filmed {
    pub(super) backend: Box<dyn Backend>,
    pub(super) sh_degree: u8,
    pub(super) background: [f32; 3],
    pub(super) normalisation: Normalisation,
    /// Those of the dataset, in scene coordinates; none of a model alone.
    pub(super) cameras: Vec<Camera>,
}

impl From<Opened> for Filmed {
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

/// Renders the flight.
pub(super) fn run(
    args: &FilmArgs,
    route: &Route,
    output: &Path,
    extras: Extras,
    filmed: Filmed,
    console: &Console,
) -> Result<(), Failure> {
    let Filmed { mut backend, sh_degree, background, normalisation, cameras } = filmed;
    let first = cameras.first().map(|first| (first.width, first.height));
    let own = |flight| SavedFlight { flight, frames: FRAMES, fps: None, size: None };
    let (saved, in_world) = match route {
        Route::Orbit => (own(camera_path::orbit(&cameras)), false),
        Route::Spiral => (own(camera_path::spiral(&cameras)), false),
        Route::File(path) => {
            (camera_path::read(path).map_err(|e| Failure::input(format!("--path: {e}")))?, true)
        }
    };
    let SavedFlight { flight, frames, fps, size } = saved;
    let frames = args.frames.unwrap_or(frames);
    let fps = args.fps.or(fps).unwrap_or(FPS);
    let size = args.size.map(|Size(width, height)| (width, height)).or(size);
    let size = size.or(first).ok_or_else(|| {
        Failure::input(
            "--path: the file does not say how large a frame is; say it with --size WIDTHxHEIGHT",
        )
    })?;
    has_room(size)?;
    let mut film = args.video.as_deref().map(|path| Film::new(path, size, fps)).transpose()?;
    let mut depths = extras.depths(&normalisation);
    for frame in 0..frames {
        let camera = flight.frame(frame, frames).camera(size);
        let camera = match in_world {
            true => normalisation.scene_from_world_camera(&camera),
            false => camera,
        };
        let rendering = backend.render(&camera, background, sh_degree)?;
        let name = format!("frame_{frame:05}");
        write_pictures(output, &name, &rendering, extras, &mut depths)?;
        if let Some(Film::WebP(path, animation)) = &mut film {
            animation
                .add(&picture(&rendering))
                .map_err(|e| Failure::new(OTHER, format!("{}: {e}", path.display())))?;
        }
    }
    depths.write(output)?;
    console.result(format_args!("{frames} frames in {}", output.display()));
    match film {
        None => return Ok(()),
        Some(Film::WebP(path, animation)) => animation.write(path)?,
        Some(Film::Mp4(path)) => encode(output, path, frames, fps)?,
    }
    let path = args.video.as_deref().unwrap_or(output);
    console.result(format_args!("film in {}", path.display()));
    Ok(())
}

/// Whether a frame can be rendered, so that one that cannot is an error and not an abort.
fn has_room((width, height): (u32, u32)) -> Result<(), Failure> {
    let bytes = PIXEL * u64::from(width) * u64::from(height);
    let size = usize::try_from(bytes).unwrap_or(usize::MAX);
    Vec::<u8>::new().try_reserve_exact(size).map_err(|_| Failure::new(DEVICE, format!(
            "a frame of {width}x{height} px takes {}, which cannot be allocated; give a smaller --size",
            Bytes(bytes)
        )))
}

fn ffmpeg(folder: &Path, arguments: &[&OsStr]) -> std::io::Result<Output> {
    let mut command = Command::new("ffmpeg");
    command.current_dir(folder).args(arguments).stdin(Stdio::null()).stdout(Stdio::null()).output()
}

/// Makes a film of the first pictures. It has its name only when it is whole.
fn encode(pictures: &Path, path: &Path, frames: u32, fps: u32) -> Result<(), Failure> {
    let failed = |problem: String| {
        Failure::new(
            OTHER,
            format!("{}: {problem}; the pictures are in {}", path.display(), pictures.display()),
        )
    };
    let film = tempfile::Builder::new().suffix(".mp4").tempfile();
    let mut film = film.map_err(|e| failed(format!("a temporary file for the film: {e}")))?;
    let (rate, count) = (fps.to_string(), frames.to_string());
    // Named from their folder, in whose own name a % would be part of the pattern.
    let input = ["-framerate", &rate, "-start_number", "0", "-i", "frame_%05d.png"];
    // More pictures may be left there of a longer flight. Colours are halved each way, so sides must be even.
    let even = "pad=ceil(iw/2)*2:ceil(ih/2)*2";
    let output =
        ["-frames:v", &count, "-vf", even, "-pix_fmt", "yuv420p", "-movflags", "+faststart"];
    let words = ["-y", "-loglevel", "error"].into_iter().chain(input).chain(output);
    let arguments: Vec<&OsStr> = words.map(OsStr::new).chain([film.path().as_os_str()]).collect();
    match ffmpeg(pictures, &arguments) {
        Ok(Output { status, .. }) if status.success() => {}
        Ok(Output { status, stderr, .. }) => {
            let said = String::from_utf8_lossy(&stderr);
            let last = said.lines().rfind(|line| !line.trim().is_empty()).unwrap_or_default();
            return Err(failed(format!("ffmpeg ended with {status}: {}", one_line(last))));
        }
        Err(e) => return Err(failed(format!("ffmpeg: {e}"))),
    }
    write_atomically(path, |out| std::io::copy(&mut film, out).map(|_| ()))?;
    Ok(())
}
