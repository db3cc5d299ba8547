//! Reads COLMAP's binary files: little endian, no padding, counts first.
//!
//! Counts are checked against the size of the file before anything is allocated.

use std::collections::HashMap;
use std::fmt::Display;
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;

use glam::{DVec2, DVec3};

use super::super::LoadError;
use super::super::PointCloud;
use super::super::lens::Lens;
use super::super::lens::models::LensModel;
use super::super::paths::MAX_NAME;
use super::super::tracks::{MAX_VIEWS, TrackSampler};
use super::camera;
use super::{Image, MAX_IMAGES, MAX_POINTS, REMEDY, RENAME};
use densify_core::files;

/// An open file and the number of bytes left in it.
struct Reader<'a> {
    path: &'a Path,
    input: BufReader<File>,
    length: u64,
    left: u64,
}

impl<'a> Reader<'a> {
    fn open(path: &'a Path) -> Result<Self, LoadError> {
        let file = files::open(path).map_err(LoadError::io(path))?;
        let length = file.metadata().map_err(LoadError::io(path))?.len();
        Ok(Self { path, input: BufReader::with_capacity(1 << 16, file), length, left: length })
    }

    fn fault(&self, field: &str, problem: impl Display) -> LoadError {
        self.fault_with_remedy(REMEDY, field, problem)
    }

    fn fault_with_remedy(&self, remedy: &str, field: &str, problem: impl Display) -> LoadError {
        let place = format!("byte {}: {field}", self.length - self.left);
        LoadError::malformed(self.path, place, problem, remedy)
    }

    /// Accounts for bytes that are about to be read; fails if the file has fewer left.
    fn claim(&mut self, field: &str, bytes: u64) -> Result<(), LoadError> {
        if bytes > self.left {
            let problem = format!(
                "the file ends here: {bytes} bytes needed, {} left (truncated?)",
                self.left
            );
            return Err(self.fault(field, problem));
        }
        self.left -= bytes;
        Ok(())
    }

    fn bytes<const N: usize>(&mut self, field: &str) -> Result<[u8; N], LoadError> {
        self.claim(field, N as u64)?;
        let mut bytes = [0; N];
        self.input.read_exact(&mut bytes).map_err(LoadError::io(self.path))?;
        Ok(bytes)
    }

    fn u64(&mut self, field: &str) -> Result<u64, LoadError> {
        self.bytes(field).map(u64::from_le_bytes)
    }

    fn u32(&mut self, field: &str) -> Result<u32, LoadError> {
        self.bytes(field).map(u32::from_le_bytes)
    }

    fn f64(&mut self, field: &str) -> Result<f64, LoadError> {
        self.bytes(field).map(f64::from_le_bytes)
    }

    fn f64s<const N: usize>(&mut self, field: &str) -> Result<[f64; N], LoadError> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = self.f64(field)?;
        }
        Ok(values)
    }

    /// Skips `count` records of `size` bytes.
    fn skip(&mut self, field: &str, count: u64, size: u64) -> Result<(), LoadError> {
        let bytes = count.saturating_mul(size);
        self.claim(field, bytes)?;
        // `claim` has bounded the number by the length of the file.
        let bytes = i64::try_from(bytes).map_err(|_| self.fault(field, "too long"))?;
        self.input.seek_relative(bytes).map_err(LoadError::io(self.path))
    }

    /// Reads the number of records, each of which takes at least `size` bytes; more than `max_count` are an error.
    fn count(&mut self, field: &str, size: u64, max_count: u64) -> Result<u64, LoadError> {
        let count = self.u64(field)?;
        if count > max_count {
            let problem = format!("the file says {count}, but at most {max_count} are supported");
            return Err(self.fault(field, problem));
        }
        if count > self.left / size {
            let problem = format!(
                "the file says {count}, but the {} bytes that follow hold at most {}",
                self.left,
                self.left / size
            );
            return Err(self.fault(field, problem));
        }
        Ok(count)
    }

    fn name(&mut self, field: &str) -> Result<String, LoadError> {
        let mut name = Vec::new();
        loop {
            match self.bytes::<1>(field)? {
                [0] => break,
                [byte] if name.len() < MAX_NAME => name.push(byte),
                _ => return Err(self.fault(field, "the name is longer than 4 KiB")),
            }
        }
        let text = String::from_utf8(name);
        text.map_err(|_| self.fault_with_remedy(RENAME, field, "the name is not UTF-8"))
    }

    fn expect_end(&self, field: &str, count: u64) -> Result<(), LoadError> {
        if self.left == 0 {
            return Ok(());
        }
        let problem = format!("{} bytes follow the {count} records the file announced", self.left);
        Err(self.fault(field, problem))
    }
}

/// Reads cameras.bin.
pub(super) fn cameras(path: &Path) -> Result<HashMap<u32, Lens>, LoadError> {
    let mut reader = Reader::open(path)?;
    // Id, model, size, and at least two parameters.
    let count = reader.count("number of cameras", 4 + 4 + 16 + 16, MAX_IMAGES)?;
    let mut cameras = HashMap::new();
    for _ in 0..count {
        let id = reader.u32("camera id")?;
        let field = format!("camera {id}");
        let model = i32::from_le_bytes(reader.bytes(&field)?);
        let model = LensModel::numbered(path, &field, model)?;
        let size = [reader.u64(&field)?, reader.u64(&field)?];
        let lens = camera::lens(model, path, &field, size, || reader.f64(&field))?;
        if cameras.insert(id, lens).is_some() {
            return Err(reader.fault(&field, "the id occurs twice"));
        }
    }
    reader.expect_end("cameras", count)?;
    Ok(cameras)
}

/// Reads the number of images.
fn read_image_count(reader: &mut Reader<'_>) -> Result<u64, LoadError> {
    // Id, pose, camera, the NUL of an empty name, number of observations.
    reader.count("number of images", 4 + 56 + 4 + 1 + 8, MAX_IMAGES)
}

/// Number of images in images.bin.
pub(super) fn image_count(path: &Path) -> Result<u64, LoadError> {
    read_image_count(&mut Reader::open(path)?)
}

/// Reads images.bin without its observations.
pub(super) fn images(path: &Path) -> Result<Vec<Image>, LoadError> {
    let mut reader = Reader::open(path)?;
    let count = read_image_count(&mut reader)?;
    let mut images = Vec::new();
    for _ in 0..count {
        let id = reader.u32("image id")?;
        let field = format!("image id {id}");
        let q = reader.f64s::<4>(&field)?;
        let t = reader.f64s::<3>(&field)?;
        let camera = reader.u32(&field)?;
        let name = reader.name(&field)?;
        let observations = reader.u64(&field)?;
        reader.skip(&field, observations, 24)?;
        images.push(Image::checked(path, id, name, camera, q, t)?);
    }
    reader.expect_end("images", count)?;
    Ok(images)
}

/// Passes the observations of images.bin to `see`: the image's id, the observation's index in it, and its place `[px]`.
pub(super) fn observations(
    path: &Path,
    see: &mut dyn FnMut(u32, u32, DVec2),
) -> Result<(), LoadError> {
    let mut reader = Reader::open(path)?;
    for _ in 0..read_image_count(&mut reader)? {
        let id = reader.u32("image id")?;
        let field = format!("image id {id}");
        reader.skip(&field, 1, 56 + 4)?;
        reader.name(&field)?;
        for observation in 0..reader.count(&field, 24, u64::from(u32::MAX))? {
            let [x, y] = reader.f64s::<2>(&field)?;
            reader.skip(&field, 1, 8)?;
            see(id, observation as u32, DVec2::new(x, y));
        }
    }
    Ok(())
}

/// Reads points3D.bin, and passes its tracks to `tracks`.
pub(super) fn points(
    path: &Path,
    mut tracks: Option<&mut TrackSampler>,
) -> Result<PointCloud, LoadError> {
    let mut reader = Reader::open(path)?;
    // Id, position, colour, error, length of the track.
    let count = reader.count("number of points", 8 + 24 + 3 + 8 + 8, MAX_POINTS)?;
    let mut points = PointCloud::default();
    for _ in 0..count {
        let field = "point";
        reader.skip(field, 1, 8)?;
        let position = reader.f64s::<3>(field)?;
        let colour = reader.bytes::<3>(field)?;
        reader.skip(field, 1, 8)?;
        let position = DVec3::from(position);
        let views = reader.u64(field)?;
        // A track is a list of pairs of image id and observation index.
        let mut left = views;
        if let Some(tracks) = tracks.as_deref_mut()
            && tracks.wants(views)
        {
            let mut ids = Vec::new();
            for _ in 0..views.min(MAX_VIEWS) {
                ids.push((reader.u32(field)?, reader.u32(field)?));
            }
            left -= ids.len() as u64;
            tracks.add(position, colour, ids);
        }
        reader.skip(field, left, 8)?;
        points.positions.push(position);
        points.colours.push(colour);
    }
    reader.expect_end("points", count)?;
    Ok(points)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn observations_are_those_of_the_text_format() {
        let folder = tempfile::tempdir().unwrap();
        let [binary, text] = ["images.bin", "images.txt"].map(|name| folder.path().join(name));
        let mut bytes = 2u64.to_le_bytes().to_vec();
        for (id, name) in [(7u32, "a.png"), (9, "b.png")] {
            bytes.extend(id.to_le_bytes());
            bytes.extend(
                [1.0, 0.0, 0.0, 0.0, 0.5, 0.25, 4.0].iter().flat_map(|v: &f64| v.to_le_bytes()),
            );
            bytes.extend(1u32.to_le_bytes());
            bytes.extend(name.bytes().chain([0]));
            bytes.extend(2u64.to_le_bytes());
            for place in [1.5, f64::from(id)] {
                bytes.extend([place, 2.5].iter().flat_map(|v: &f64| v.to_le_bytes()));
                bytes.extend([0xff; 8]);
            }
        }
        std::fs::write(&binary, bytes).unwrap();
        let image = |id: u32, name: &str| {
            format!("{id} 1 0 0 0 0.5 0.25 4 1 {name}\n1.5 2.5 -1 {id} 2.5 -1\n")
        };
        std::fs::write(&text, image(7, "a.png") + &image(9, "b.png")).unwrap();
        let [mut of_binary, mut of_text] = [Vec::new(), Vec::new()];
        observations(&binary, &mut |id, at, pixel| of_binary.push((id, at, pixel))).unwrap();
        let see = &mut |id, at, pixel| of_text.push((id, at, pixel));
        super::super::txt::observations(&text, see).unwrap();
        assert_eq!(of_binary, of_text);
        assert_eq!(of_binary[3], (9, 1, DVec2::new(9.0, 2.5)));
    }

    /// A file of 100 bytes cannot hold 13 records of 8 bytes, and 12 may be more than are supported.
    #[test]
    fn impossible_counts_state_the_limit_that_they_exceed() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("points3D.bin");
        for (count, max, words) in [
            (12, 20, None),
            (13, 20, Some("the 100 bytes that follow hold at most 12")),
            (12, 11, Some("at most 11 are supported")),
        ] {
            std::fs::write(&path, [&u64::to_le_bytes(count)[..], &[0; 100]].concat()).unwrap();
            let found = Reader::open(&path).unwrap().count("number of points", 8, max);
            match words {
                None => assert_eq!(found.unwrap(), count),
                Some(words) => {
                    let message = found.unwrap_err().to_string();
                    assert!(message.contains(words), "{message}");
                }
            }
        }
    }
}
