//! Caches rendered built-in scenes in the user's cache folder, because ray tracing takes longer than many runs.
//! The key contains a checksum of the program, so that a new build renders the scenes again.

use std::collections::HashMap;
use std::fs::{self, File};
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::time::SystemTime;

use densify_scenegen::{Frame, InitPoints, Options};
use etcetera::BaseStrategy;
use glam::DVec3;
use safetensors::SafeTensors;
use safetensors::tensor::{Dtype, TensorView};

use super::{Rendered, Summary};
use densify_core::files::write_atomically;

/// Largest total size of all entries `[bytes]`; the least recently used entries are removed first.
const MAX_BYTES: u64 = 1 << 30;
const EXTENSION: &str = "safetensors";
const CHECKSUM: &str = "crc32c";

/// The file with the code of densify, if it is not the program of the process.
static PROGRAM_FILE: OnceLock<PathBuf> = OnceLock::new();

/// Names the file with the code of densify, for a library within another program. Only the first call has an effect.
pub fn set_program_file(file: PathBuf) {
    let _ = PROGRAM_FILE.set(file);
}

/// The folder of cached scenes, if the user has a cache folder.
pub fn cache_folder() -> Option<PathBuf> {
    let base = etcetera::choose_base_strategy().ok()?;
    Some(base.cache_dir().join("densify").join("scenes"))
}

/// The cache entry of a scene.
pub(super) struct Entry {
    path: PathBuf,
}

impl Entry {
    /// The entry of the built-in scene `name`; `None` if the program's own file cannot be read.
    pub(super) fn new(folder: &Path, name: &str, options: &Options) -> Option<Self> {
        let program = match PROGRAM_FILE.get() {
            Some(file) => file.clone(),
            None => std::env::current_exe().ok()?,
        };
        let program = file_checksum(&program).ok()?;
        let parameters = crc32c::crc32c(format!("{options:?}").as_bytes());
        // Some systems do not allow the colon of `town:4` in file names.
        let name = name.replace(':', "-");
        let name = format!("{name}-{program:08x}-{parameters:08x}.{EXTENSION}");
        Some(Self { path: folder.join(name) })
    }

    /// Reads the scene, if the entry exists and is undamaged.
    pub(super) fn read(&self) -> Option<Rendered> {
        let mut bytes = Vec::new();
        File::open(&self.path).ok()?.take(MAX_BYTES).read_to_end(&mut bytes).ok()?;
        // Mark the entry as used. This may fail in a shared, read-only cache.
        let file = File::options().write(true).open(&self.path);
        let _ = file.and_then(|file| file.set_modified(SystemTime::now()));
        let (_, metadata) = SafeTensors::read_metadata(&bytes).ok()?;
        let tensors = SafeTensors::deserialize(&bytes).ok()?;
        let checksum = metadata.metadata().as_ref()?.get(CHECKSUM)?;
        (*checksum == checksum_of(tensors.tensors())).then(|| decode(&tensors))?
    }

    /// Writes the scene. Errors are ignored, as the cache only saves time.
    pub(super) fn write(&self, scene: &Rendered) {
        if let Err(error) = self.try_write(scene) {
            tracing::debug!(%error, "the scene is not cached");
        }
    }

    fn try_write(
        &self,
        Rendered { summary, frames, points }: &Rendered,
    ) -> Result<(), Box<dyn std::error::Error>> {
        let summary = serde_json::to_vec(summary)?;
        let [flat, found_at] = [&points.positions, &points.found_at]
            .map(|points| points.iter().flat_map(DVec3::to_array).collect::<Vec<f64>>());
        let counts: Vec<u32> = points.seen_by.iter().map(|views| views.len() as u32).collect();
        let seen_by = points.seen_by.concat();
        let number = points.positions.len();
        let mut tensors = Vec::new();
        for (index, frame) in frames.iter().enumerate() {
            let shape = vec![frame.height as usize, frame.width as usize, 4];
            tensors.push((image_name(index), TensorView::new(Dtype::U8, shape, &frame.rgba)?));
        }
        for (name, kind, shape, bytes) in [
            ("about", Dtype::U8, vec![summary.len()], &summary[..]),
            ("positions", Dtype::F64, vec![number, 3], bytemuck::cast_slice(&flat)),
            ("found_at", Dtype::F64, vec![number, 3], bytemuck::cast_slice(&found_at)),
            ("colours", Dtype::U8, vec![number, 3], points.colours.as_flattened()),
            ("view_counts", Dtype::U32, vec![number], bytemuck::cast_slice(&counts)),
            ("seen_by", Dtype::U32, vec![seen_by.len()], bytemuck::cast_slice(&seen_by)),
        ] {
            tensors.push((name.to_owned(), TensorView::new(kind, shape, bytes)?));
        }
        let metadata = HashMap::from([(CHECKSUM.to_owned(), checksum_of(tensors.clone()))]);
        let bytes = safetensors::serialize(tensors, Some(metadata))?;
        write_atomically(&self.path, |out| out.write_all(&bytes))?;
        self.path.parent().map_or(Ok(()), |folder| evict(folder, MAX_BYTES))?;
        Ok(())
    }
}

fn image_name(index: usize) -> String {
    format!("image_{index:05}")
}

/// The checksum of all tensors, in the order of their names.
fn checksum_of(mut tensors: Vec<(String, TensorView<'_>)>) -> String {
    tensors.sort_by(|(a, _), (b, _)| a.cmp(b));
    let sum = tensors.iter().fold(0, |sum, (name, tensor)| {
        let sum = crc32c::crc32c_append(sum, format!("{name}{:?}", tensor.shape()).as_bytes());
        crc32c::crc32c_append(sum, tensor.data())
    });
    format!("{sum:08x}")
}

/// Decodes an entry whose checksum is correct.
fn decode(tensors: &SafeTensors<'_>) -> Option<Rendered> {
    let frames = (0..).map_while(|index| tensors.tensor(&image_name(index)).ok());
    let frames: Option<Vec<Frame>> = frames.map(|image| frame(&image)).collect();
    let bytes = |name: &str| Some(tensors.tensor(name).ok()?.data());
    let u32s = |name: &str| -> Option<Vec<u32>> {
        let words = bytes(name)?.as_chunks().0.iter();
        Some(words.map(|&word| u32::from_le_bytes(word)).collect())
    };
    let places = |name: &str| -> Option<Vec<DVec3>> {
        let numbers = bytes(name)?.as_chunks().0.iter().map(|&word| f64::from_le_bytes(word));
        let numbers: Vec<f64> = numbers.collect();
        Some(numbers.as_chunks().0.iter().map(|&point| DVec3::from_array(point)).collect())
    };
    let (positions, found_at) = (places("positions")?, places("found_at")?);
    let colours = bytes("colours")?.as_chunks().0.to_vec();
    let mut seen = u32s("seen_by")?.into_iter();
    let counts = u32s("view_counts")?.into_iter();
    let seen_by = counts.map(|count| seen.by_ref().take(count as usize).collect()).collect();
    // The other fields of the points are not used by datasets.
    let points = InitPoints { positions, found_at, colours, seen_by, ..InitPoints::default() };
    let summary: Summary = serde_json::from_slice(bytes("about")?).ok()?;
    Some(Rendered { summary, frames: frames?, points })
}

fn frame(image: &TensorView<'_>) -> Option<Frame> {
    let &[height, width, 4] = image.shape() else { return None };
    Some(Frame {
        width: u32::try_from(width).ok()?,
        height: u32::try_from(height).ok()?,
        rgba: image.data().to_vec(),
        exposed: None,
        mask: None,
        depth: Vec::new(),
        normals: Vec::new(),
        triangles: Vec::new(),
    })
}

/// The checksum of a file's contents.
fn file_checksum(path: &Path) -> io::Result<u32> {
    let mut file = File::open(path)?;
    let mut buffer = vec![0; 1 << 16];
    let mut sum = 0;
    loop {
        match file.read(&mut buffer)? {
            0 => return Ok(sum),
            read => sum = crc32c::crc32c_append(sum, &buffer[..read]),
        }
    }
}

/// Removes the least recently used entries until the total size is at most `max_bytes`.
fn evict(folder: &Path, max_bytes: u64) -> io::Result<()> {
    let mut entries = Vec::new();
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        let metadata = entry.metadata()?;
        // Incomplete files left behind by killed processes are counted and removed like entries.
        let is_entry = entry.path().extension().is_some_and(|extension| extension == EXTENSION);
        if is_entry || entry.file_name().as_encoded_bytes().starts_with(b".densify-") {
            entries.push((metadata.modified()?, metadata.len(), entry.path()));
        }
    }
    entries.sort();
    let mut total: u64 = entries.iter().map(|(_, bytes, _)| bytes).sum();
    for (_, bytes, path) in entries {
        if total <= max_bytes {
            break;
        }
        fs::remove_file(path)?;
        total -= bytes;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use densify_scenegen::{Camera, Split, View};

    use super::*;

    fn sample() -> Rendered {
        let frame = |value: u8| Frame {
            width: 2,
            height: 1,
            rgba: vec![value; 8],
            exposed: None,
            mask: None,
            depth: Vec::new(),
            normals: Vec::new(),
            triangles: Vec::new(),
        };
        let points = InitPoints {
            positions: vec![DVec3::new(1.0, -0.1, 1e-9), DVec3::splat(7.25)],
            found_at: vec![DVec3::new(1.0, -0.2, 1e-9), DVec3::splat(7.5)],
            colours: vec![[1, 2, 3], [4, 5, 6]],
            seen_by: vec![vec![0, 2], vec![1]],
            ..InitPoints::default()
        };
        let camera = Camera::looking(DVec3::new(0.1, 0.2, 0.3), DVec3::X, DVec3::Y, 0.7, (2, 1));
        let view = |name: &str, split| View { name: name.to_owned(), split, camera };
        let views = vec![view("train/r_000", Split::Train), view("test/r_000", Split::Test)];
        let summary = Summary { views, notes: vec!["a note".to_owned()], surface_bytes: 5 };
        Rendered { summary, frames: vec![frame(3), frame(250)], points }
    }

    fn has_colon(path: &Path) -> bool {
        path.file_name().is_some_and(|name| name.to_string_lossy().contains(':'))
    }

    fn is_sample(read: Option<Rendered>) -> bool {
        read.is_some_and(|read| read == sample())
    }

    #[test]
    fn only_intact_entries_of_the_same_scene_are_read_back() {
        let folder = tempfile::tempdir().unwrap();
        let entry = |options: &Options| Entry::new(folder.path(), "spheres", options).unwrap();
        let default = entry(&Options::default());
        assert!(default.read().is_none());
        default.write(&sample());
        assert!(is_sample(default.read()));
        // Scenes with different parameters have different entries.
        assert!(entry(&Options { seed: 9, ..Options::default() }).read().is_none());
        // So do scenes of different sizes.
        let sized = |name| Entry::new(folder.path(), name, &Options::default()).unwrap();
        let [town, larger] = ["town", "town:4"].map(sized);
        town.write(&sample());
        assert!(is_sample(town.read()) && larger.read().is_none() && !has_colon(&larger.path));
        // A damaged entry counts as missing.
        let whole = fs::read(&default.path).unwrap();
        for at in (0..whole.len()).step_by(7) {
            let mut damaged = whole.clone();
            damaged[at] ^= 16;
            fs::write(&default.path, &damaged).unwrap();
            let read = default.read();
            assert!(read.is_none() || is_sample(read), "byte {at}");
        }
        fs::write(&default.path, &whole[..whole.len() - 1]).unwrap();
        assert!(default.read().is_none());
    }

    #[test]
    fn the_least_recently_used_entries_are_removed_first() {
        let folder = tempfile::tempdir().unwrap();
        for (name, age) in [("a", 30), ("b", 10), ("c", 20)] {
            let path = folder.path().join(name).with_extension(EXTENSION);
            fs::write(&path, [0; 100]).unwrap();
            let then = SystemTime::now() - std::time::Duration::from_secs(age);
            File::options().write(true).open(&path).unwrap().set_modified(then).unwrap();
        }
        fs::write(folder.path().join("other.txt"), [0; 900]).unwrap();
        evict(folder.path(), 200).unwrap();
        let exists = |name: &str| folder.path().join(name).with_extension(EXTENSION).exists();
        assert_eq!(["a", "b", "c"].map(exists), [false, true, true]);
        assert!(folder.path().join("other.txt").exists());
    }
}
