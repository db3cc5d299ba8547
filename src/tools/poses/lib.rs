//! Finds the cameras of photographs with pycolmap, and keeps only poses that other photographs confirm.
//!
//! [`find`] lists the photographs or takes frames from a video, runs the stages of the engine in a folder of
//! intermediate results beside the output, checks the models, and writes the best one as a COLMAP scene.
//!
//! Its modules in order, each using only those before it: `error`, `model`, `checks`, `upright`, `engine`, `video`,
//! `attempts`, `scene`, `work` and `result`.

mod attempts;
mod checks;
mod engine;
mod error;
mod model;
mod result;
mod scene;
mod upright;
mod video;
mod work;

use std::fs;
use std::path::{Path, PathBuf};

use attempts::MIN_VIEWS;
use densify_core::files::FileError;
use densify_data::dataset::{Photograph, Photographs, is_video};
use densify_run::Observer;
use engine::Engine;
pub use error::PosesError;
use result::{best, finish};
use scene::Report;
use work::{begin, lock, task, work_folder};

/// Least number of photographs.
const MIN_PHOTOGRAPHS: usize = MIN_VIEWS;

/// What to find, and how.
#[derive(Debug, Clone)]
pub struct Options {
    /// Folder of photographs, or a video.
    pub input: PathBuf,
    /// Folder of the scene to write.
    pub output: PathBuf,
    /// The Python that has pycolmap; `None`: the usual names.
    pub python: Option<PathBuf>,
    /// Threads of the engine.
    pub threads: u32,
    /// COLMAP's name of the camera model.
    pub camera_model: String,
    /// Frames to take from a video.
    pub frames: u32,
    /// True if the world stays as the engine has chosen it.
    pub keep_frame: bool,
    /// True if an existing output is replaced.
    pub overwrite: bool,
}

/// A scene that was found.
#[derive(Debug, Clone, PartialEq)]
pub struct Found {
    /// Number of photographs.
    pub photographs: usize,
    /// Number of those in the scene.
    pub accepted: usize,
}

/// True if a path is a video, or a folder with photographs but without the files of a dataset.
#[must_use]
pub fn are_photographs(path: &Path) -> bool {
    if path.is_file() {
        return is_video(path);
    }
    let is_listed = |name: &str| path.join(name).exists();
    let files = ["sparse", "colmap", "transforms.json", "transforms_train.json"];
    let has_table = || {
        let entries = fs::read_dir(path).into_iter().flatten().flatten();
        entries
            .map(|entry| entry.path())
            .any(|path| path.extension().is_some_and(|kind| kind == "csv"))
    };
    path.is_dir()
        && !files.into_iter().any(is_listed)
        && !has_table()
        && Photographs::list(path)
            .is_ok_and(|found| !found.all.is_empty() || !found.notes.is_empty())
}

/// True if `scene` was found from the photographs in `input` as they are now.
#[must_use]
pub fn is_current(input: &Path, scene: &Path) -> bool {
    let Some(report) = Report::read(scene) else { return false };
    let now = match is_video(input) {
        true => fs::metadata(input).map(|data| vec![(String::new(), data.len())]).ok(),
        false => Photographs::list(input).ok().map(|found| identity(&found.all)),
    };
    let input = input.canonicalize().ok();
    Some(report.input) == input && Some(report.photographs) == now
}

fn identity(photographs: &[Photograph]) -> Vec<(String, u64)> {
    photographs.iter().map(|photograph| (photograph.name.clone(), photograph.bytes)).collect()
}

/// Finds the poses of photographs and writes the scene. A call that was stopped or has failed is continued by the next
/// one with the same output.
///
/// # Errors
/// When there are too few photographs, no engine or no acceptable model, or a file cannot be written. The output is
/// then as before.
pub fn find(options: &Options, observer: &dyn Observer) -> Result<Found, PosesError> {
    let Options { input, output, .. } = options;
    let is_empty =
        |folder: &Path| fs::read_dir(folder).is_ok_and(|mut entries| entries.next().is_none());
    if output.exists() && !options.overwrite && !is_empty(output) {
        return Err(PosesError::Occupied { folder: output.clone() });
    }
    let listed = if is_video(input) { None } else { Some(list(input, observer)?) };
    let work = work_folder(output);
    let engine = Engine::find(options.python.as_deref(), &work)?;
    fs::create_dir_all(&work).map_err(FileError::io("create the folder", &work))?;
    let lock = lock(&work)?;
    let original = listed.as_ref().map_or_else(
        || vec![(String::new(), fs::metadata(input).map_or(0, |data| data.len()))],
        |listed| identity(&listed.all),
    );
    begin(&work, options, &original)?;
    engine.install()?;
    observer.say(format_args!(
        "engine   {}, {} threads, results in {}",
        engine.name(),
        options.threads,
        work.display()
    ));
    let photographs = match listed {
        Some(listed) => listed,
        None => {
            let (frames, log) = (work.join("frames"), work.join("log.txt"));
            video::take_frames((input, options.frames), (&frames, &log), observer)?;
            list(&frames, observer)?
        }
    };
    let task = task(options, &photographs, &work)?;
    let candidates = attempts::reconstruct(&task, &engine, observer)?;
    let count = photographs.all.len();
    let best = best(candidates, count, observer)?;
    let report = Report {
        input: input.canonicalize().unwrap_or_else(|_| input.clone()),
        photographs: original,
        engine: engine.name(),
        ..Report::default()
    };
    let found = finish(options, (best, report), (&photographs, &task), observer)?;
    drop(lock);
    let _ = fs::remove_dir_all(&work);
    Ok(found)
}

fn list(folder: &Path, observer: &dyn Observer) -> Result<Photographs, PosesError> {
    let found = Photographs::list(folder)?;
    if found.all.len() < MIN_PHOTOGRAPHS {
        let (folder, count, notes) = (folder.to_owned(), found.all.len(), found.notes);
        return Err(PosesError::TooFew { folder, count, needed: MIN_PHOTOGRAPHS, notes });
    }
    for note in &found.notes {
        observer.say(format_args!("note     {note}"));
    }
    Ok(found)
}

#[cfg(all(test, unix))]
mod tests;
