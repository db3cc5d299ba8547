//! `densify render --path`: the options of a camera path and its film.

use std::path::{Path, PathBuf};

use clap::Args;

use super::console::Console;
use densify_core::camera_path::MAX_SIDE;
use densify_inspect::{CameraRoute, Channels, Film, FilmError, FilmOptions, FilmSource};
use densify_run::failure::{DEVICE, Failure, OTHER};

/// Maximum number of frames.
const MAX_FRAMES: u32 = 100_000;

/// Options of a camera path.
#[derive(Debug, Args)]
#[command(next_help_heading = "Camera path")]
pub(super) struct FilmArgs {
    /// Render along a camera path instead of the dataset's views: orbit (once around the point that the cameras look
    /// at), spiral (two turns in front of it), or a camera path saved by the page of `densify view` or by nerfstudio's
    /// viewer (JSON). A file must be in the dataset's coordinates. The page writes such files; nerfstudio does if it
    /// trained with `--orientation-method none --center-method none --auto-scale-poses False`
    #[arg(long, value_name = "orbit|spiral|FILE")]
    pub(super) path: Option<CameraRoute>,
    /// Number of frames `[default: 120; for a file, its seconds times its fps, or one per camera]`
    #[arg(long, value_name = "N", requires = "path", value_parser = clap::value_parser!(u32).range(1..=i64::from(MAX_FRAMES)))]
    frames: Option<u32>,
    /// Width and height of the frames, such as 640x480 `[default: those of the file, else of the first photograph]`
    #[arg(long, value_name = "WxH", requires = "path", value_parser = parse_size)]
    size: Option<(u32, u32)>,
    /// Frames per second of the film `[default: those of the file, else 30]`
    #[arg(long, value_name = "N", requires = "video", value_parser = clap::value_parser!(u32).range(1..=1000))]
    fps: Option<u32>,
    /// Also write a film: .mp4 (needs the program ffmpeg) or .webp (lossless, by densify itself)
    #[arg(long, value_name = "FILE", requires = "path")]
    video: Option<PathBuf>,
}

/// Parses width and height `[px]`.
fn parse_size(text: &str) -> Result<(u32, u32), String> {
    let sides = text.split_once('x').map(|(width, height)| [width, height].map(str::parse));
    match sides {
        Some([Ok(width), Ok(height)])
            if [width, height].iter().all(|side| (1..=MAX_SIDE).contains(side)) =>
        {
            Ok((width, height))
        }
        _ => Err(format!("give WIDTHxHEIGHT, such as 640x480, each from 1 to {MAX_SIDE}")),
    }
}

/// Renders the camera path.
pub(super) fn run(
    args: &FilmArgs,
    route: &CameraRoute,
    output: &Path,
    channels: Channels,
    source: FilmSource,
    console: &Console,
) -> Result<(), Failure> {
    let options = FilmOptions {
        frames: args.frames,
        size: args.size,
        fps: args.fps,
        video: args.video.as_deref(),
    };
    let film = Film::make(route, options, output, channels, source).map_err(with_option_names)?;
    if let (Some(note), CameraRoute::File(path)) = (film.note, route) {
        console.say(format_args!("note: {}: {note}", path.display()));
    }
    console.result(format_args!("{} frames in {}", film.frames, output.display()));
    if let Some(video) = &args.video {
        console.result(format_args!("film in {}", video.display()));
    }
    Ok(())
}

/// The failure; its message names the options.
fn with_option_names(error: FilmError) -> Failure {
    match error {
        FilmError::Path(error) => Failure::input(format!("--path: {error}")),
        FilmError::NoSize => {
            Failure::input(format!("--path: {error}; set it with --size WIDTHxHEIGHT"))
        }
        FilmError::OutOfMemory { .. } => {
            Failure::new(DEVICE, format!("{error}; give a smaller --size"))
        }
        FilmError::TooLargeForWebP { .. } => {
            Failure::input(format!("--video {error}; give a smaller --size"))
        }
        FilmError::UnknownFormat { .. } | FilmError::NoFfmpeg { .. } => {
            Failure::input(format!("--video {error}"))
        }
        FilmError::Encoding { .. } | FilmError::Temporary { .. } => Failure::new(OTHER, error),
        FilmError::File(error) => error.into(),
        FilmError::Backend(error) => error.into(),
    }
}
