//! Reads COLMAP's text files: one line per record (two per image), `#` for comments.

use std::collections::HashMap;
use std::fmt::Display;
use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::str::{FromStr, SplitWhitespace};

use glam::{DVec2, DVec3};

use super::super::LoadError;
use super::super::PointCloud;
use super::super::lens::Lens;
use super::super::lens::models::LensModel;
use super::super::paths::MAX_NAME;
use super::super::tracks::TrackSampler;
use super::camera;
use super::{Image, MAX_IMAGES, MAX_POINTS, REMEDY, RENAME};
use densify_core::files;

/// Longest line accepted `[bytes]`. The longest lines list an image's observations of about 40 bytes each.
const MAX_LINE: u64 = 64 << 20;

struct Lines<'a> {
    path: &'a Path,
    input: BufReader<File>,
    number: u64,
    line: Vec<u8>,
}

impl<'a> Lines<'a> {
    fn open(path: &'a Path) -> Result<Self, LoadError> {
        let file = files::open(path).map_err(LoadError::io(path))?;
        Ok(Self { path, input: BufReader::new(file), number: 0, line: Vec::new() })
    }

    fn fault(&self, field: &str, problem: impl Display) -> LoadError {
        self.fault_with_remedy(REMEDY, field, problem)
    }

    fn fault_with_remedy(&self, remedy: &str, field: &str, problem: impl Display) -> LoadError {
        let place = format!("line {}: {field}", self.number);
        LoadError::malformed(self.path, place, problem, remedy)
    }

    /// Reads the next line, even if it is a comment; false at the end of the file.
    fn advance(&mut self) -> Result<bool, LoadError> {
        self.line.clear();
        self.number += 1;
        let read = (&mut self.input).take(MAX_LINE).read_until(b'\n', &mut self.line);
        let read = read.map_err(LoadError::io(self.path))?;
        if self.number == 1 {
            if let Some(problem) = files::wrong_kind(&self.line) {
                return Err(self.fault("the file", problem));
            }
            if self.line.starts_with("\u{feff}".as_bytes()) {
                self.line.drain(..3);
            }
        }
        if read as u64 == MAX_LINE {
            return Err(self.fault("the line", "it is longer than 64 MiB"));
        }
        Ok(read > 0)
    }

    /// Reads the next line that is neither empty nor a comment; false at the end of the file.
    fn advance_to_record(&mut self) -> Result<bool, LoadError> {
        while self.advance()? {
            let text = self.line.trim_ascii_start();
            if !text.is_empty() && text[0] != b'#' {
                return Ok(true);
            }
        }
        Ok(false)
    }

    fn text(&self) -> Result<&str, LoadError> {
        let text = std::str::from_utf8(&self.line);
        text.map_err(|_| self.fault_with_remedy(RENAME, "the line", "a name in it is not UTF-8"))
    }

    /// The next word of the line as a number.
    fn number<T: FromStr>(
        &self,
        words: &mut SplitWhitespace<'_>,
        field: &str,
    ) -> Result<T, LoadError> {
        let word = words.next().ok_or_else(|| self.fault(field, "the line ends too early"))?;
        word.parse().map_err(|_| {
            let word: String = word.chars().take(40).collect();
            self.fault(field, format!("{word:?} is not a valid number"))
        })
    }

    fn numbers<const N: usize>(
        &self,
        words: &mut SplitWhitespace<'_>,
        field: &str,
    ) -> Result<[f64; N], LoadError> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = self.number(words, field)?;
        }
        Ok(values)
    }
}

/// Reads cameras.txt.
pub(super) fn cameras(path: &Path) -> Result<HashMap<u32, Lens>, LoadError> {
    let mut lines = Lines::open(path)?;
    let mut cameras = HashMap::new();
    while lines.advance_to_record()? {
        let mut words = lines.text()?.split_whitespace();
        let id: u32 = lines.number(&mut words, "camera id")?;
        let field = format!("camera {id}");
        let model = words.next().ok_or_else(|| lines.fault(&field, "the model is missing"))?;
        let model = LensModel::named(path, &field, model)?;
        let size = [lines.number(&mut words, "width")?, lines.number(&mut words, "height")?];
        let (found, needed) = (words.clone().count(), model.parameters());
        if found != needed {
            let problem = format!("{} has {needed} parameters, not {found}", model.name);
            return Err(lines.fault(&field, problem));
        }
        let next = || lines.number(&mut words, "camera parameters");
        let lens = camera::lens(model, path, &field, size, next)?;
        if cameras.insert(id, lens).is_some() {
            return Err(lines.fault(&field, "the id occurs twice"));
        }
    }
    Ok(cameras)
}

/// Reads images.txt. An image has two lines. The second one lists its observations; it may be empty, and some programs
/// leave it out.
pub(super) fn images(path: &Path) -> Result<Vec<Image>, LoadError> {
    let mut lines = Lines::open(path)?;
    let mut images = Vec::new();
    // True if the first line of the next image has already been read.
    let mut is_ahead = false;
    while is_ahead || lines.advance_to_record()? {
        let text = lines.text()?;
        let mut words = text.split_whitespace();
        let id: u32 = lines.number(&mut words, "image id")?;
        let field = format!("image id {id}");
        let q = lines.numbers::<4>(&mut words, &field)?;
        let t = lines.numbers::<3>(&mut words, &field)?;
        let camera: u32 = lines.number(&mut words, "camera id")?;
        // The name is the rest of the line and may contain spaces.
        let name = after_words(text, 9);
        if name.is_empty() || name.len() > MAX_NAME {
            return Err(lines.fault(&field, "the name is missing or longer than 4 KiB"));
        }
        images.push(Image::checked(path, id, name.to_owned(), camera, q, t)?);
        if images.len() as u64 > MAX_IMAGES {
            return Err(lines.fault("images", "there are more than a million"));
        }
        lines.advance()?;
        let is_comment = lines.line.trim_ascii_start().starts_with(b"#");
        is_ahead = !is_comment && has_non_number(lines.text()?);
        if is_ahead || is_comment {
            continue;
        }
        let words = lines.text()?.split_whitespace().take(10).count();
        if words % 3 != 0 && words < 10 {
            return Err(lines.fault("observations", "they do not come in triples (X, Y, point id)"));
        }
        if words == 10 && lines.text()?.split_whitespace().count() % 3 != 0 {
            return Err(lines.fault(
                "observations",
                "they do not come in triples (X, Y, point id); an image without observations needs \
                 an empty line",
            ));
        }
    }
    Ok(images)
}

/// Passes the observations of images.txt, which [`images`] has read, to `see`: the image's id, the observation's index
/// in it, and its place `[px]`.
pub(super) fn observations(
    path: &Path,
    see: &mut dyn FnMut(u32, u32, DVec2),
) -> Result<(), LoadError> {
    let mut lines = Lines::open(path)?;
    let mut is_ahead = false;
    while is_ahead || lines.advance_to_record()? {
        let id: u32 = lines.number(&mut lines.text()?.split_whitespace(), "image id")?;
        lines.advance()?;
        let is_comment = lines.line.trim_ascii_start().starts_with(b"#");
        is_ahead = !is_comment && has_non_number(lines.text()?);
        if is_ahead || is_comment {
            continue;
        }
        let mut words = lines.text()?.split_whitespace();
        let mut observation = 0;
        while let (Some(x), Some(y), Some(_)) = (words.next(), words.next(), words.next()) {
            // A place that is no number is unknown.
            if let (Ok(x), Ok(y)) = (x.parse(), y.parse()) {
                see(id, observation, DVec2::new(x, y));
            }
            observation += 1;
        }
    }
    Ok(())
}

/// Returns true if a line contains a word that is not a number, such as the name of an image. Only the first 100 words
/// are tested, because only lines of observations have more.
fn has_non_number(text: &str) -> bool {
    text.split_whitespace().take(100).any(|word| word.parse::<f64>().is_err())
}

/// The rest of a line after its first `count` words.
fn after_words(text: &str, count: usize) -> &str {
    let mut rest = text.trim();
    for _ in 0..count {
        rest = rest.find(char::is_whitespace).map_or("", |end| rest[end..].trim_start());
    }
    rest
}

/// Reads points3D.txt, and passes its tracks to `tracks`.
pub(super) fn points(
    path: &Path,
    mut tracks: Option<&mut TrackSampler>,
) -> Result<PointCloud, LoadError> {
    let mut lines = Lines::open(path)?;
    let mut points = PointCloud::default();
    while lines.advance_to_record()? {
        let mut words = lines.text()?.split_whitespace();
        let _: u64 = lines.number(&mut words, "point id")?;
        let position = lines.numbers::<3>(&mut words, "position")?;
        let mut colour = [0u8; 3];
        for channel in &mut colour {
            *channel = lines.number(&mut words, "colour")?;
        }
        let position = DVec3::from(position);
        if let Some(tracks) = tracks.as_deref_mut() {
            // The reprojection error, then pairs of image id and observation index.
            let _ = words.next();
            let views = words.clone().count() as u64 / 2;
            if tracks.wants(views) {
                let mut ids = Vec::new();
                while let (Some(id), Some(observation)) = (words.next(), words.next()) {
                    let id = id
                        .parse()
                        .map_err(|_| lines.fault("track", format!("{id:?} is not an image id")))?;
                    // Some programs write −1 where they know of no observation.
                    ids.push((id, observation.parse().unwrap_or(u32::MAX)));
                }
                tracks.add(position, colour, ids);
            }
        }
        points.positions.push(position);
        points.colours.push(colour);
        if points.positions.len() as u64 > MAX_POINTS {
            return Err(lines.fault("points", "there are more than 2^28"));
        }
    }
    Ok(points)
}
