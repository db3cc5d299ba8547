//! Datasets in ZIP archives, unpacked into a temporary folder, which is removed when the dataset and all its
//! views are dropped.
//!
//! The reader of each format then sees an ordinary folder, from which photographs are decoded as fast as from any other
//! folder. Archives are untrusted: no name leads out of the folder, no links are created, and the unpacked size is
//! bounded before and during unpacking.

use std::fs::{self, File, OpenOptions};
use std::io::{self, BufReader, Read};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use tempfile::TempDir;
use zip::ZipArchive;
use zip::result::ZipError;

use super::LoadError;
use super::paths::{lexical_fault, relative};
use super::{Dataset, LoadOptions, Note, View};
use crate::models::{folder_in_archive, is_streamed};
use densify_core::files;
use densify_core::memory::Bytes;

/// Largest accepted number of files in an archive.
const MAX_FILES: usize = 4_000_000;
/// Maximum number of nested folders around the dataset's folder, each of which contains only the next one.
const MAX_OUTER_FOLDERS: usize = 8;
/// Names of files and folders that operating systems add to archives.
const SYSTEM_FILES: [&str; 4] = ["__MACOSX", ".DS_Store", "Thumbs.db", "desktop.ini"];
const REMEDY: &str = "pack the folder again, or unpack the archive and give that folder instead";

/// The files of an archive in a temporary folder, which is removed when this value is dropped.
#[derive(Debug)]
pub(super) struct Unpacked {
    archive: PathBuf,
    temporary: TempDir,
    /// The dataset's folder inside the temporary folder.
    folder: PathBuf,
    bytes: u64,
}

/// Returns true if a file, whatever its name, is a complete ZIP archive other than a SOG model, streamed or not.
pub fn is_archive(path: &Path) -> bool {
    let is_model = |archive: &ZipArchive<BufReader<File>>| {
        let names: Vec<_> = archive.file_names().flatten().collect();
        folder_in_archive(&names).is_some() || is_streamed(&names)
    };
    is_zip(path) && open(path).is_ok_and(|archive| !is_model(&archive))
}

/// Returns true if a file begins like a ZIP archive; the archive may still be damaged.
pub(super) fn is_zip(path: &Path) -> bool {
    let mut start = [0; 2];
    path.is_file()
        && files::open(path)
            .is_ok_and(|mut file| file.read_exact(&mut start).is_ok() && start == *b"PK")
}

/// Loads the dataset in an archive.
///
/// # Errors
/// When the archive is damaged, unsafe or too large for the disk, and as [`Dataset::load`].
pub(super) fn load(path: &Path, options: &LoadOptions) -> Result<Dataset, LoadError> {
    let unpacked = Arc::new(Unpacked::new(path)?);
    let mut dataset = Dataset::load_folder(&unpacked.folder, options)
        .map_err(|error| unpacked.error_with_archive_name(error))?;
    for note in &mut dataset.notes {
        match note {
            Note::Text(text) => *text = unpacked.with_archive_name(text),
            Note::DepthLeftOut(error) => {
                **error = unpacked.error_with_archive_name((**error).clone());
            }
            _ => {}
        }
    }
    let (bytes, folder) = (Bytes(unpacked.bytes), unpacked.temporary.path().display());
    dataset.notes.push(Note::Text(format!(
        "{} is unpacked in {folder} ({bytes}) while this command runs",
        path.display()
    )));
    for View { source, .. } in dataset.train.iter_mut().chain(&mut dataset.test) {
        source.file = source.file.clone().in_archive(&unpacked);
        if let Some(mask) = &mut source.mask {
            mask.file = mask.file.clone().in_archive(&unpacked);
        }
        for file in source.depth.iter_mut().flat_map(|depth| depth.files_mut()) {
            *file = file.clone().in_archive(&unpacked);
        }
    }
    path.clone_into(&mut dataset.root);
    dataset.unpacked = Some(unpacked);
    Ok(dataset)
}

impl Unpacked {
    fn new(path: &Path) -> Result<Self, LoadError> {
        let mut archive = open(path)?;
        let max_bytes = max_unpacked_bytes(path)?;
        let bytes = checked_size(path, &mut archive, max_bytes)?;
        let temporary = tempfile::Builder::new()
            .prefix("densify-zip-")
            .tempdir()
            .map_err(|error| no_room(path, &std::env::temp_dir(), bytes, &error))?;
        let mut bytes_left = max_bytes;
        for index in 0..archive.len() {
            let mut file = archive.by_index(index).map_err(|error| broken(path, &error))?;
            let Some(name) = data_name(path, &file)? else { continue };
            let target = temporary.path().join(&name);
            let parent = target.parent().map_or(Ok(()), fs::create_dir_all);
            // A second file of the same name must not replace the first.
            let opened =
                parent.and_then(|()| OpenOptions::new().write(true).create_new(true).open(&target));
            let mut output = opened.map_err(|error| match error.kind() {
                io::ErrorKind::AlreadyExists | io::ErrorKind::NotADirectory => {
                    malformed(path, &name, "another file has this name")
                }
                _ => no_room(path, temporary.path(), bytes, &error),
            })?;
            // The length in the table of contents may be false.
            let mut input = (&mut file).take(bytes_left + 1);
            let copied = copy(&mut input, &mut output).map_err(|error| match error {
                CopyError::Read(error) => {
                    malformed(path, &name, format!("it cannot be unpacked: {error}"))
                }
                CopyError::Write(error) => no_room(path, temporary.path(), bytes, &error),
            })?;
            bytes_left = bytes_left.checked_sub(copied).ok_or_else(|| zip_bomb(path, max_bytes))?;
        }
        let folder = innermost(temporary.path());
        Ok(Self { archive: path.to_owned(), temporary, folder, bytes })
    }

    /// The dataset's folder.
    pub(super) fn folder(&self) -> &Path {
        &self.folder
    }

    /// Replaces the temporary folder with the archive's name in a message.
    pub(super) fn with_archive_name(&self, text: &str) -> String {
        let archive = self.archive.to_string_lossy();
        [&*self.folder, self.temporary.path()].iter().fold(text.to_owned(), |text, folder| {
            text.replace(&*folder.to_string_lossy(), &archive)
        })
    }

    /// Replaces the temporary folder with the archive's name in an error.
    pub(super) fn error_with_archive_name(&self, error: LoadError) -> LoadError {
        match error {
            LoadError::Data(problem) => LoadError::Data(self.with_archive_name(&problem)),
            LoadError::Remedied { problem, remedy } => {
                LoadError::Remedied { problem: self.with_archive_name(&problem), remedy }
            }
            LoadError::NoMasks { listing, inverted } => {
                LoadError::NoMasks { listing: self.path_in_archive(&listing), inverted }
            }
            // The view list is the user's own file, outside the archive.
            LoadError::ViewList { .. } => error,
        }
    }

    /// Replaces the temporary folder with the archive's name in a path.
    pub(super) fn path_in_archive(&self, path: &Path) -> PathBuf {
        let rest = path.strip_prefix(&self.folder);
        let rest = rest.or_else(|_| path.strip_prefix(self.temporary.path()));
        rest.map_or_else(|_| path.to_owned(), |rest| self.archive.join(rest))
    }
}

fn open(path: &Path) -> Result<ZipArchive<BufReader<File>>, LoadError> {
    let file = files::open(path).map_err(LoadError::io(path))?;
    ZipArchive::new(BufReader::new(file)).map_err(|error| broken(path, &error))
}

/// Largest unpacked size that is accepted `[bytes]`.
fn max_unpacked_bytes(path: &Path) -> Result<u64, LoadError> {
    let packed = fs::metadata(path).map_err(LoadError::io(path))?.len();
    Ok(files::max_unpacked_bytes(packed))
}

/// Checks the table of contents; returns the size of the unpacked files `[bytes]`.
fn checked_size<R: Read + io::Seek>(
    path: &Path,
    archive: &mut ZipArchive<R>,
    max_bytes: u64,
) -> Result<u64, LoadError> {
    if archive.len() > MAX_FILES {
        return Err(malformed(path, "archive", format!("it has more than {MAX_FILES} files")));
    }
    let mut bytes = 0_u64;
    for index in 0..archive.len() {
        let file = archive.by_index_raw(index).map_err(|error| broken(path, &error))?;
        if data_name(path, &file)?.is_some() {
            bytes = bytes.saturating_add(file.size());
        }
    }
    if bytes > max_bytes { Err(zip_bomb(path, max_bytes)) } else { Ok(bytes) }
}

/// The path of a file in the archive; `None` for folders and for files that operating systems add.
fn data_name<R: Read>(
    path: &Path,
    file: &zip::read::ZipFile<'_, R>,
) -> Result<Option<String>, LoadError> {
    // Many programs write UTF-8 without declaring it.
    let name = match std::str::from_utf8(file.name_raw()) {
        Ok(name) => name.to_owned(),
        Err(_) => file.name().map_err(|error| broken(path, &error))?.into_owned(),
    };
    // Some programs write the separators of Windows.
    let name = name.replace('\\', "/");
    let shown: String = name.chars().take(200).collect();
    if let Some(problem) = lexical_fault(&name) {
        return Err(malformed(path, &shown, format!("the path {problem}")));
    }
    if file.is_symlink() {
        return Err(malformed(path, &shown, "it is a symbolic link, which is not followed"));
    }
    let is_data = |part: &str| !SYSTEM_FILES.contains(&part);
    if name.ends_with('/') || file.is_dir() || !relative(&name).split('/').all(is_data) {
        return Ok(None);
    }
    if file.encrypted() {
        let problem = "it is encrypted";
        return Err(LoadError::malformed(path, shown, problem, "pack it again without a password"));
    }
    Ok(Some(relative(&name)))
}

/// Descends through folders that contain nothing but one folder.
fn innermost(folder: &Path) -> PathBuf {
    let mut folder = folder.to_owned();
    for _ in 0..MAX_OUTER_FOLDERS {
        let mut entries = fs::read_dir(&folder).into_iter().flatten().flatten();
        match (entries.next(), entries.next()) {
            (Some(only), None) if only.path().is_dir() => folder = only.path(),
            _ => break,
        }
    }
    folder
}

enum CopyError {
    Read(io::Error),
    Write(io::Error),
}

/// Copies a file; the error distinguishes a damaged archive from a full disk.
fn copy(input: &mut impl Read, output: &mut File) -> Result<u64, CopyError> {
    let mut buffer = vec![0; 1 << 16];
    let mut copied = 0;
    loop {
        let read = input.read(&mut buffer).map_err(CopyError::Read)?;
        if read == 0 {
            return Ok(copied);
        }
        io::Write::write_all(output, &buffer[..read]).map_err(CopyError::Write)?;
        copied += read as u64;
    }
}

fn malformed(path: &Path, place: &str, problem: impl std::fmt::Display) -> LoadError {
    LoadError::malformed(path, place, problem, REMEDY)
}

fn broken(path: &Path, error: &ZipError) -> LoadError {
    malformed(path, "archive", error)
}

fn zip_bomb(path: &Path, limit: u64) -> LoadError {
    let problem =
        format!("it unpacks to more than {}, which is implausible for photographs", Bytes(limit));
    let remedy = "unpack it yourself if you trust it, and give the unpacked folder instead";
    LoadError::malformed(path, "archive", problem, remedy)
}

fn no_room(path: &Path, folder: &Path, bytes: u64, error: &io::Error) -> LoadError {
    LoadError::Data(format!(
        "cannot unpack {} into {}: {error}; set TMPDIR to a folder with room for {}, or unpack it yourself and give \
         the unpacked folder instead",
        path.display(),
        folder.display(),
        Bytes(bytes)
    ))
}
