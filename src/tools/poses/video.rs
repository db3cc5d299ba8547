//! Takes sharp frames from a video, with ffmpeg.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use image::GrayImage;
use image::imageops::FilterType;

use crate::engine::run_logged;
use crate::error::PosesError;
use densify_core::files::FileError;
use densify_run::Observer;

/// Frames looked at for each one taken.
const OVERSAMPLING: f64 = 2.5;
/// Longest side at which sharpness is measured `[px]`.
const SHARPNESS_SIDE: u32 = 512;
/// Transfer curves of HDR, as ffmpeg names them.
const HDR: [(&str, &str); 2] = [("arib-std-b67", "HLG"), ("smpte2084", "PQ")];

/// Writes the sharpest frame of each of `wanted` equal parts of a video into `folder`, unless an earlier call has.
///
/// # Errors
/// When ffmpeg is missing or fails, or the video is HDR.
pub(crate) fn take_frames(
    (video, wanted): (&Path, u32),
    (folder, log): (&Path, &Path),
    observer: &dyn Observer,
) -> Result<(), PosesError> {
    if folder.is_dir() {
        return Ok(());
    }
    let (seconds, native) = duration(video)?;
    let (all, taken) = (folder.with_extension("all"), folder.with_extension("partial"));
    for folder in [&all, &taken] {
        let _ = fs::remove_dir_all(folder);
        fs::create_dir_all(folder).map_err(FileError::io("create the folder", folder))?;
    }
    // A higher rate than the video's own would repeat frames.
    let rate = (OVERSAMPLING * f64::from(wanted) / seconds).min(native);
    let mut command = Command::new("ffmpeg");
    command.args(["-nostdin", "-v", "error", "-i"]).arg(video);
    command.args(["-vf", &format!("fps={rate}"), "-q:v", "2"]).arg(all.join("%06d.jpg"));
    run_logged((command, "ffmpeg", "frames"), log, observer)?;
    let mut frames: Vec<PathBuf> = fs::read_dir(&all)
        .map_err(FileError::io("read the folder", &all))?
        .filter_map(|entry| entry.ok().map(|entry| entry.path()))
        .collect();
    frames.sort();
    let parts = (wanted as usize).min(frames.len());
    for part in 0..parts {
        let window = &frames[part * frames.len() / parts..(part + 1) * frames.len() / parts];
        // The first of equally sharp frames, so that the choice is always the same.
        let mut best = (f64::NEG_INFINITY, &window[0]);
        for frame in window {
            let sharp = sharpness(frame).unwrap_or(f64::NEG_INFINITY);
            best = if sharp > best.0 { (sharp, frame) } else { best };
        }
        let name = best.1.file_name().unwrap_or_default();
        let to = taken.join(name);
        fs::rename(best.1, &to).map_err(FileError::io("write", &to))?;
    }
    let _ = fs::remove_dir_all(&all);
    observer.say(format_args!("frames   the sharpest {parts} of {}", frames.len()));
    fs::rename(&taken, folder).map_err(FileError::io("write", folder))?;
    Ok(())
}

/// The length of a video `[s]`, and its frames per second.
fn duration(video: &Path) -> Result<(f64, f64), PosesError> {
    let fault = |problem: String| PosesError::Video { file: video.to_owned(), problem };
    let described = Command::new("ffmpeg")
        .args(["-nostdin", "-hide_banner", "-i"])
        .arg(video)
        .stdin(Stdio::null())
        .output();
    let described = described.map_err(|error| {
        fault(format!("ffmpeg, which reads videos, cannot be started ({error}); install it"))
    })?;
    let text = String::from_utf8_lossy(&described.stderr);
    if let Some((_, name)) = HDR.iter().find(|(curve, _)| text.contains(curve)) {
        return Err(fault(format!(
            "its colours are HDR ({name}), which densify does not read; convert it to standard range, or record with \
             HDR switched off"
        )));
    }
    let seconds = parse_duration(&text).filter(|seconds| *seconds > 0.0).ok_or_else(|| {
        fault("ffmpeg finds no video of known length in it; give a complete video file".to_owned())
    })?;
    Ok((seconds, parse_rate(&text).unwrap_or(f64::INFINITY)))
}

/// The seconds of the line `Duration: 00:01:02.50, …`.
fn parse_duration(text: &str) -> Option<f64> {
    if !text.contains("Video:") {
        return None;
    }
    let (_, rest) = text.split_once("Duration: ")?;
    let mut seconds = 0.0;
    for part in rest.split(',').next()?.trim().split(':') {
        seconds = 60.0 * seconds + part.parse::<f64>().ok()?;
    }
    Some(seconds)
}

/// The number before ` fps` in the line of the video.
fn parse_rate(text: &str) -> Option<f64> {
    let (before, _) = text.split_once(" fps")?;
    before.rsplit(' ').next()?.parse().ok().filter(|rate| *rate > 0.0)
}

/// Variance of the Laplacian: comparable only between frames with the same content.
fn sharpness(frame: &Path) -> Option<f64> {
    let picture = image::open(frame).ok()?;
    let grey = picture.resize(SHARPNESS_SIDE, SHARPNESS_SIDE, FilterType::Triangle).to_luma8();
    Some(laplacian_variance(&grey))
}

fn laplacian_variance(grey: &GrayImage) -> f64 {
    let (width, height) = grey.dimensions();
    let at = |x: u32, y: u32| f64::from(grey.get_pixel(x, y).0[0]);
    let (mut sum, mut squares, mut count) = (0.0, 0.0, 0.0_f64);
    for y in 1..height.saturating_sub(1) {
        for x in 1..width.saturating_sub(1) {
            let value = at(x - 1, y) + at(x + 1, y) + at(x, y - 1) + at(x, y + 1) - 4.0 * at(x, y);
            (sum, squares, count) = (sum + value, squares + value * value, count + 1.0);
        }
    }
    let mean = sum / count.max(1.0);
    squares / count.max(1.0) - mean * mean
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_length_of_a_video_is_read() {
        let text =
            "  Duration: 00:01:02.50, start: 0.0, bitrate: 9 kb/s\n  Stream #0:0: Video: h264\n";
        assert_eq!(parse_duration(text), Some(62.5));
        assert_eq!(parse_duration("Duration: N/A, Video:"), None);
        assert_eq!(parse_rate("Video: h264, yuv420p, 640x480, 29.97 fps, 30 tbr"), Some(29.97));
        assert_eq!(parse_duration("Duration: 00:00:02.0, Audio: aac"), None);
    }

    #[test]
    fn a_blurred_picture_is_less_sharp() {
        let sharp = GrayImage::from_fn(64, 64, |x, y| {
            image::Luma([if (x / 4 + y / 4) % 2 == 0 { 220 } else { 30 }])
        });
        let blurred = image::imageops::blur(&sharp, 2.0);
        assert!(laplacian_variance(&blurred) < 0.3 * laplacian_variance(&sharp));
    }
}
