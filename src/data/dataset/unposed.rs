//! Lists photographs whose cameras are not known yet, and names files that cannot be used, with the remedy.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use super::LoadError;
use super::exif::Exif;
use super::images;

/// Levels of subfolders that are searched.
const DEPTH: u32 = 3;
/// Folders beside or among photographs whose pictures are no photographs.
const OTHER_FOLDERS: [&str; 8] =
    ["masks", "mask", "segmentation", "dynamic_masks", "depth", "depths", "confidence", "sparse"];
/// Folders of masks that are passed on.
const MASK_FOLDERS: [&str; 2] = ["masks", "mask"];
const READABLE: [&str; 4] = ["jpg", "jpeg", "png", "webp"];
const HEIC: [&str; 4] = ["heic", "heif", "hif", "avif"];
const RAW: [&str; 10] = ["dng", "cr2", "cr3", "nef", "arw", "raf", "orf", "rw2", "tif", "tiff"];
const VIDEOS: [&str; 6] = ["mov", "mp4", "m4v", "avi", "mkv", "webm"];

/// A photograph whose camera is not known.
#[derive(Debug, Clone, PartialEq)]
pub struct Photograph {
    /// Path below the folder, with `/` as separator.
    pub name: String,
    /// Width and height as stored `[px]`.
    pub size: (u32, u32),
    /// Size of the file `[bytes]`.
    pub bytes: u64,
    /// Make, model and focal length in EXIF, if all are stated.
    pub lens: Option<String>,
    /// Direction in the stored image (x right, y down) that is up when the photograph is shown upright.
    pub up: [f64; 2],
    /// Its mask, if there is one.
    pub mask: Option<PathBuf>,
}

/// The photographs in a folder, sorted by name.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Photographs {
    /// The folder.
    pub folder: PathBuf,
    /// The photographs.
    pub all: Vec<Photograph>,
    /// Lines about files that are not used, with the remedy.
    pub notes: Vec<String>,
}

/// True if a path has the extension of a video.
pub fn is_video(path: &Path) -> bool {
    VIDEOS.contains(&&*extension(path))
}

fn extension(path: &Path) -> String {
    path.extension().map(|text| text.to_string_lossy().to_ascii_lowercase()).unwrap_or_default()
}

impl Photographs {
    /// Lists the photographs in a folder and its subfolders; in its folder `images/` alone, if that has any.
    ///
    /// # Errors
    /// When the folder or a photograph cannot be read. A folder without photographs is none.
    pub fn list(folder: &Path) -> Result<Self, LoadError> {
        let within = folder.join("images");
        let root = if within.is_dir() { &*within } else { folder };
        let mut files = Vec::new();
        walk(root, DEPTH, &mut files)?;
        files.sort();
        let stems: BTreeSet<PathBuf> = files
            .iter()
            .filter(|file| {
                READABLE.contains(&&*extension(file)) || HEIC.contains(&&*extension(file))
            })
            .map(|file| file.with_extension(""))
            .collect();
        let mut unused: BTreeMap<&str, Vec<String>> = BTreeMap::new();
        let mut all = Vec::new();
        for file in files {
            let inside = file.strip_prefix(root).unwrap_or(&file);
            let name = inside.to_string_lossy().replace('\\', "/");
            let kind = extension(&file);
            let reason = match &*kind {
                kind if READABLE.contains(&kind) => {
                    all.push(photograph(folder, &file, name)?);
                    continue;
                }
                kind if HEIC.contains(&kind) => {
                    "HEIC is not read: convert with `heif-convert FILE FILE.jpg`; iPhones take JPEG with Settings, \
                     Camera, Formats, Most Compatible"
                }
                kind if RAW.contains(&kind) => {
                    "raw files and TIFF are not read: export them as JPEG"
                }
                _ if is_video(&file) && stems.contains(&file.with_extension("")) => {
                    "each is the film of a Live Photo, whose still is used"
                }
                _ if is_video(&file) => {
                    "videos among photographs are not used: name a video itself instead"
                }
                _ => continue,
            };
            unused.entry(reason).or_default().push(name);
        }
        let notes = unused.into_iter().map(|(reason, names)| {
            let (first, count) = (&names[0], names.len());
            let others = if count > 1 { format!(" and {} more", count - 1) } else { String::new() };
            format!("not used: {first}{others} ({reason})")
        });
        Ok(Self { folder: root.to_owned(), all, notes: notes.collect() })
    }
}

fn walk(folder: &Path, depth: u32, files: &mut Vec<PathBuf>) -> Result<(), LoadError> {
    for entry in fs::read_dir(folder).map_err(LoadError::io(folder))? {
        let path = entry.map_err(LoadError::io(folder))?.path();
        let name =
            path.file_name().map(|name| name.to_string_lossy().to_lowercase()).unwrap_or_default();
        let is_link = path.is_symlink();
        if name.starts_with('.') {
            continue;
        }
        if path.is_file() {
            files.push(path);
        } else if path.is_dir() && !is_link && depth > 0 && !OTHER_FOLDERS.contains(&&*name) {
            walk(&path, depth - 1, files)?;
        }
    }
    Ok(())
}

/// Reads what is known about a photograph without decoding it.
fn photograph(folder: &Path, file: &Path, name: String) -> Result<Photograph, LoadError> {
    let header = images::read_header(file)?;
    let exif = Exif::open(file);
    let inside = Path::new(&name);
    let mask = MASK_FOLDERS.iter().find_map(|masks| {
        let masks = folder.join(masks);
        let names =
            [format!("{name}.png"), inside.with_extension("png").to_string_lossy().into_owned()];
        names.map(|name| masks.join(name)).into_iter().find(|mask| mask.is_file())
    });
    let (size, bytes) = ((header.width, header.height), header.file_bytes);
    Ok(Photograph { name, size, bytes, up: exif.up(), lens: exif.lens, mask })
}
