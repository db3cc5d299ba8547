//! The folder of intermediate results: what it is about, who works in it, and the photographs under plain names.

use std::collections::BTreeMap;
use std::fs::{self, File, TryLockError};
use std::path::{Path, PathBuf};

use crate::Options;
use crate::attempts::Task;
use crate::error::PosesError;
use crate::scene::link;
use densify_core::files::{FileError, write_atomically};
use densify_data::dataset::{Photographs, is_video};

/// The folder of intermediate results of an output.
pub(crate) fn work_folder(output: &Path) -> PathBuf {
    let name =
        output.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    output.with_file_name(format!("{name}.unfinished"))
}

pub(crate) fn lock(work: &Path) -> Result<File, PosesError> {
    let path = work.join("lock");
    let file = File::options()
        .create(true)
        .append(true)
        .open(&path)
        .map_err(FileError::io("write", &path))?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => Err(PosesError::Busy { work: work.to_owned() }),
        Err(TryLockError::Error(error)) => Err(FileError::io("lock", &path)(error).into()),
    }
}

/// The file that says what a folder of intermediate results is about.
const SUBJECT: &str = "subject.json";

/// Empties the folder of intermediate results if they are about other photographs or settings.
pub(crate) fn begin(
    work: &Path,
    options: &Options,
    photographs: &[(String, u64)],
) -> Result<(), PosesError> {
    let subject = serde_json::json!({
        "input": options.input.canonicalize().unwrap_or_default().to_string_lossy(),
        "photographs": photographs,
        "camera_model": options.camera_model,
        "frames": options.frames,
    });
    let (path, text) = (work.join(SUBJECT), subject.to_string());
    if fs::read_to_string(&path).is_ok_and(|known| known == text) {
        return Ok(());
    }
    for entry in fs::read_dir(work).into_iter().flatten().flatten() {
        if entry.file_name() != "lock" {
            let path = entry.path();
            let removed =
                if path.is_dir() { fs::remove_dir_all(&path) } else { fs::remove_file(&path) };
            removed.map_err(FileError::io("remove", &path))?;
        }
    }
    write_atomically(&path, |out| out.write_all(text.as_bytes()))?;
    Ok(())
}

/// What photographs by one camera have in common: lens in EXIF, size, and without EXIF the folder.
type Shared<'a> = (&'a str, (u32, u32), &'a str);

/// Links the photographs under names without spaces, and groups them by camera.
pub(crate) fn task<'a>(
    options: &'a Options,
    photographs: &Photographs,
    work: &'a Path,
) -> Result<Task<'a>, PosesError> {
    let images = work.join("images");
    let masks = work.join("masks");
    let mut names = Vec::with_capacity(photographs.all.len());
    let mut groups: BTreeMap<Shared<'_>, Vec<usize>> = BTreeMap::new();
    for (index, photograph) in photographs.all.iter().enumerate() {
        let path = Path::new(&photograph.name);
        let kind =
            path.extension().map(|kind| kind.to_string_lossy().to_lowercase()).unwrap_or_default();
        let name = format!("{index:06}.{kind}");
        link(&photographs.folder.join(path), &images.join(&name))?;
        if let Some(mask) = &photograph.mask {
            link(mask, &masks.join(format!("{name}.png")))?;
        }
        names.push(name);
        // Without EXIF, photographs of one size in one folder count as by one camera.
        let folder = if photograph.lens.is_some() {
            ""
        } else {
            path.parent().and_then(Path::to_str).unwrap_or("")
        };
        let lens = photograph.lens.as_deref().unwrap_or("");
        groups.entry((lens, photograph.size, folder)).or_default().push(index);
    }
    let masks = photographs.all.iter().any(|photograph| photograph.mask.is_some()).then_some(masks);
    let (is_sequence, groups) = (is_video(&options.input), groups.into_values().collect());
    let (camera_model, threads) = (&*options.camera_model, options.threads);
    Ok(Task { images, names, groups, masks, is_sequence, camera_model, threads, work })
}
