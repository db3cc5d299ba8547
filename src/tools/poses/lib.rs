//! Finds the cameras of photographs with pycolmap, and keeps only poses that other photographs confirm.
//!
//! [`find`] lists the photographs or takes frames from a video, runs the stages of the engine in a folder of
//! intermediate results beside the output, checks the models, and writes the best one as a COLMAP scene.
//!
//! Its modules in order, each using only those before it: `error`, `model`, `checks`, `upright`, `engine`, `video`,
//! `attempts` and `scene`.

mod attempts;
mod checks;
mod engine;
mod error;
mod model;
mod scene;
mod upright;
mod video;

use std::collections::{BTreeMap, HashMap};
use std::fs::{self, File, TryLockError};
use std::path::{Path, PathBuf};

use attempts::{Candidate, MIN_VIEWS, Task};
use densify_core::files::{FileError, write_atomically};
use densify_data::dataset::{Photograph, Photographs, is_video};
use densify_run::Observer;
use engine::Engine;
pub use error::PosesError;
use scene::{Report, link};

/// Least number of photographs.
const MIN_PHOTOGRAPHS: usize = MIN_VIEWS;
/// Names that a line lists at most.
const LISTED: usize = 5;

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
    fs::create_dir_all(&work).map_err(FileError::io("create the folder", &work))?;
    let lock = lock(&work)?;
    let engine = Engine::find(options.python.as_deref(), &work).inspect_err(|_| {
        // Nothing has been found yet.
        let _ = fs::remove_dir(&work).or_else(|_| remove_unless_begun(&work));
    })?;
    let original = listed.as_ref().map_or_else(
        || vec![(String::new(), fs::metadata(input).map_or(0, |data| data.len()))],
        |listed| identity(&listed.all),
    );
    begin(&work, options, &original)?;
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

/// The folder of intermediate results of an output.
fn work_folder(output: &Path) -> PathBuf {
    let name =
        output.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    output.with_file_name(format!("{name}.unfinished"))
}

fn lock(work: &Path) -> Result<File, PosesError> {
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

fn remove_unless_begun(work: &Path) -> std::io::Result<()> {
    if work.join(SUBJECT).exists() { Ok(()) } else { fs::remove_dir_all(work) }
}

/// Empties the folder of intermediate results if they are about other photographs or settings.
fn begin(work: &Path, options: &Options, photographs: &[(String, u64)]) -> Result<(), PosesError> {
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
        let is_kept = ["lock", "engine.py"].iter().any(|name| entry.file_name() == *name);
        if !is_kept {
            let path = entry.path();
            let removed =
                if path.is_dir() { fs::remove_dir_all(&path) } else { fs::remove_file(&path) };
            removed.map_err(FileError::io("remove", &path))?;
        }
    }
    write_atomically(&path, |out| out.write_all(text.as_bytes()))?;
    Ok(())
}

/// Links the photographs under names without spaces, and groups them by camera.
fn task<'a>(
    options: &'a Options,
    photographs: &Photographs,
    work: &'a Path,
) -> Result<Task<'a>, PosesError> {
    let images = work.join("images");
    let masks = work.join("masks");
    let mut names = Vec::with_capacity(photographs.all.len());
    let mut groups: BTreeMap<(&str, (u32, u32), &str), Vec<usize>> = BTreeMap::new();
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

/// The candidate with most accepted views, if it has enough; names the others.
fn best(
    candidates: Vec<Candidate>,
    count: usize,
    observer: &dyn Observer,
) -> Result<Candidate, PosesError> {
    let mut candidates = candidates.into_iter();
    let Some(best) = candidates.next() else { return Err(PosesError::NothingInCommon { count }) };
    if best.accepted() < MIN_VIEWS {
        let registered = best.model.images.len();
        let why = match best.verdict.contradicted {
            0 => "no photographs confirm each other's poses".to_owned(),
            contradicted => format!("matches contradict {contradicted} of their poses"),
        };
        return Err(PosesError::Contradicted { registered, count, why });
    }
    let names: Vec<&str> = best.model.images.iter().map(|image| &*image.name).collect();
    for other in candidates {
        let apart = other.model.images.iter().all(|image| !names.contains(&&*image.name));
        if apart && other.accepted() >= MIN_VIEWS {
            observer.say(format_args!(
                "note     {} photographs form a scene of their own and are not used; to train on it, put them into a \
                 folder of their own",
                other.accepted()
            ));
        }
    }
    Ok(best)
}

/// Writes the scene of a candidate, and says what became of each photograph.
fn finish(
    options: &Options,
    (best, mut report): (Candidate, Report),
    (photographs, task): (&Photographs, &Task<'_>),
    observer: &dyn Observer,
) -> Result<Found, PosesError> {
    let Candidate { mut model, verdict, origin } = best;
    let place: HashMap<&str, usize> =
        task.names.iter().enumerate().map(|(at, name)| (&**name, at)).collect();
    let photograph = |name: &str| &photographs.all[place[name]];
    let mut is_placed = vec![false; photographs.all.len()];
    let mut kept: Vec<String> = Vec::new();
    for (image, reason) in model.images.iter().zip(&verdict.reasons) {
        is_placed[place[&*image.name]] = true;
        let name = photograph(&image.name).name.clone();
        match reason {
            None => kept.push(image.name.clone()),
            Some(reason) => report.rejected.push((name, reason.to_string())),
        }
    }
    model.retain(|image| kept.contains(&image.name));
    let unplaced = photographs.all.iter().zip(&is_placed).filter(|(_, placed)| !**placed);
    report.unplaced = unplaced.map(|(photograph, _)| photograph.name.clone()).collect();
    if !options.keep_frame {
        let cameras = model
            .images
            .iter()
            .map(|image| (image.rotation, image.centre(), photograph(&image.name).up));
        model.turn(upright::upright_from_world(cameras));
        observer.say(format_args!(
            "upright  turned by the cameras' up directions: up is -y (--keep-frame: not turned)"
        ));
    }
    let mut pictures = Vec::new();
    for image in &mut model.images {
        let photograph = photograph(&image.name);
        let to = Path::new("images").join(&photograph.name);
        pictures.push((photographs.folder.join(&photograph.name), to));
        if let Some(mask) = &photograph.mask {
            pictures
                .push((mask.clone(), Path::new("masks").join(format!("{}.png", photograph.name))));
        }
        image.name.clone_from(&photograph.name);
        report.accepted.push(photograph.name.clone());
    }
    report.origin = origin;
    scene::write((&model, &report), &pictures, (&task.work.join("scene"), &options.output))?;
    tell(&report, photographs.all.len(), observer);
    Ok(Found { photographs: photographs.all.len(), accepted: report.accepted.len() })
}

/// Says how many photographs are in the scene, and why the others are not.
fn tell(report: &Report, count: usize, observer: &dyn Observer) {
    let rejected: Vec<String> =
        report.rejected.iter().map(|(name, why)| format!("{name} ({why})")).collect();
    for (what, names) in [("rejected", &rejected), ("unplaced", &report.unplaced)] {
        if !names.is_empty() {
            let more = if names.len() > LISTED { ", …" } else { "" };
            let shown = names[..names.len().min(LISTED)].join(", ");
            observer.say(format_args!("{what} {} of {count}: {shown}{more}", names.len()));
        }
    }
}

#[cfg(all(test, unix))]
mod tests;
