//! Model files: those that a run has saved, and files by any program.

use std::borrow::Cow;
use std::io::Write;
use std::path::{Path, PathBuf};

use crate::failure::{Failure, ModelProblem, notes};
use crate::observer::Observer;
use densify_core::antialiasing::Antialiasing;
use densify_core::files::{self, WriteError};
use densify_core::gaussians::Gaussians;
use densify_data::dataset::is_archive;
use densify_data::models::{
    self, Coarseness, Coordinates, Format, Frame, fitting_format, is_finer_than_f32, is_unfit,
    local_origin, sidecar_path,
};
use densify_train::checkpoint::newest_step;
use densify_train::output::{is_in_use, model_path, saved_iterations};

/// True for a file that is not the archive of a dataset, and for a folder in SOG format.
pub fn is_model(path: &Path) -> bool {
    (path.is_file() && !is_archive(path)) || models::is_model_folder(path)
}

/// The iteration `asked` for, or else the last one that the run has saved.
///
/// # Errors
/// When the run has not saved that iteration, or has saved none.
pub fn iteration(run: &Path, asked: Option<u32>) -> Result<u32, Failure> {
    let saved = saved_iterations(run).map_err(|error| -> Failure {
        match newest_step(run) {
            None => error.into(),
            Some(step) => ModelProblem::NoModelYet { run: run.to_owned(), step }.into(),
        }
    })?;
    let last = saved[saved.len() - 1];
    match asked {
        None => Ok(last),
        Some(n) if saved.contains(&n) => Ok(n),
        Some(iteration) => {
            Err(ModelProblem::NoSuchIteration { iteration, run: run.to_owned(), saved }.into())
        }
    }
}

/// As [`iteration`], for a run that may still be training. If it is, tells the observer so and returns true.
///
/// # Errors
/// As [`iteration`].
pub fn iteration_so_far(
    run: &Path,
    asked: Option<u32>,
    observer: &dyn Observer,
) -> Result<(u32, bool), Failure> {
    let is_training = is_in_use(run);
    if is_training && saved_iterations(run).is_err() {
        return Err(ModelProblem::StillTraining { run: run.to_owned() }.into());
    }
    let iteration = iteration(run, asked)?;
    if is_training {
        let run = run.display();
        observer.say(format_args!(
            "note: {run} is being trained; this is its model of iteration {iteration}"
        ));
    }
    Ok((iteration, is_training))
}

/// The last part of a path, to be shown without revealing the names of the folders above it.
pub fn name_of(path: &Path) -> String {
    names_of(&[path]).swap_remove(0)
}

/// Names for paths that are shown together: each has as few parts as needed to differ from the others.
pub fn names_of(paths: &[&Path]) -> Vec<String> {
    let whole = |path: &&Path| path.canonicalize().unwrap_or_else(|_| path.to_path_buf());
    let whole: Vec<PathBuf> = paths.iter().map(whole).collect();
    let last = |path: &Path, parts: usize| -> PathBuf {
        let all: Vec<_> = path.components().collect();
        all[all.len().saturating_sub(parts)..].iter().collect()
    };
    let name = |path: &PathBuf| {
        let is_unique = |parts: &usize| {
            let mut others = whole.iter().filter(|other| *other != path);
            others.all(|other| last(other, *parts) != last(path, *parts))
        };
        let count = path.components().count();
        let parts = (1..count).find(is_unique).unwrap_or(count);
        files::one_line(&last(path, parts).to_string_lossy())
    };
    whole.iter().map(name).collect()
}

/// The file of a model: `named` itself if it is a file, else the model that the run in this folder saved at the
/// iteration asked for, by default the last.
///
/// # Errors
/// As [`iteration`], and when an iteration is given for a file.
pub fn model_file(named: &Path, asked: Option<u32>) -> Result<PathBuf, Failure> {
    if !is_model(named) {
        return Ok(model_path(named, iteration(named, asked)?));
    }
    match asked {
        Some(_) => Err(ModelProblem::IterationOfFile.into()),
        None => Ok(named.to_owned()),
    }
}

/// Reads a file of Gaussian splats, written by any program, in its own coordinates. Tells the user about rows that were
/// dropped or repaired, and passes on the notes on the file.
///
/// # Errors
/// When it cannot be read.
pub fn read_model(path: &Path, observer: &dyn Observer) -> Result<Gaussians, Failure> {
    read_model_as(path, None, observer)
}

/// Reads a model as [`read_model`] does, with the antialiasing `given` instead of the one that the file states.
///
/// # Errors
/// When it cannot be read.
pub fn read_model_as(
    path: &Path,
    given: Option<Antialiasing>,
    observer: &dyn Observer,
) -> Result<Gaussians, Failure> {
    let mut file = models::read_model(path)?;
    for (number, problem) in [
        (file.dropped, "left out: a value is not finite, or all are 0"),
        (file.repaired, "with a zero quaternion, read as unrotated"),
    ] {
        if number > 0 {
            observer.say(format_args!("note: {}: {number} rows {problem}", path.display()));
        }
    }
    for note in &file.notes {
        observer.say(format_args!("note: {}: {note}", path.display()));
    }
    if let Some(given) = given {
        override_antialiasing(&mut file.gaussians, given, path, observer);
    }
    Ok(file.gaussians)
}

/// Gives a model the antialiasing of the option; tells the user if the model's file states another.
pub(crate) fn override_antialiasing(
    model: &mut Gaussians,
    given: Antialiasing,
    path: &Path,
    observer: &dyn Observer,
) {
    if model.antialiasing != given {
        let option = notes::antialias_option(observer.spelling(), given);
        let stated = model.antialiasing;
        observer.say(format_args!(
            "note: {}: assumed to be trained with {option}; the file states {}",
            path.display(),
            if stated.is_on() { stated.name() } else { "no antialiasing" }
        ));
        model.antialiasing = given;
    }
}

/// The model in the coordinates of the file to write, and their frame. Automatic coordinates are local if f32 is too
/// coarse for world coordinates. A model that itself has only world coordinates in f32 keeps them in lossless formats.
fn in_coordinates_of_file<'a>(
    model: &'a Gaussians,
    coordinates: Coordinates,
    format: &Format,
    observer: &dyn Observer,
) -> Result<(Cow<'a, Gaussians>, Frame), Failure> {
    let in_frame = |frame: Frame| {
        let is_there = model.has_origin(frame.origin);
        let moved = || Cow::Owned(model.clone().with_origin(frame.origin));
        Ok((if is_there { Cow::Borrowed(model) } else { moved() }, frame))
    };
    let local = || Frame::from_origin(local_origin(model));
    match coordinates {
        Coordinates::Local => return in_frame(local()),
        Coordinates::Double => return in_frame(Frame { is_double: true, ..local() }),
        Coordinates::Auto | Coordinates::World => {}
    }
    let coarseness = Coarseness::measure(model);
    if !coarseness.is_noted() {
        return in_frame(Frame::WORLD);
    }
    let (is_fine, spelling) = (is_finer_than_f32(model), observer.spelling());
    if coordinates == Coordinates::Auto && (is_fine || format.is_lossy()) {
        let local = local();
        observer
            .say(format_args!("{}", notes::saved_in_local(spelling, &coarseness, local.origin)));
        return in_frame(local);
    }
    if is_fine && coarseness.is_unfit() {
        return Err(Failure::input(notes::coarse(spelling, &coarseness, !format.is_lossy())));
    }
    let note = if is_fine {
        notes::coarse(spelling, &coarseness, !format.is_lossy())
    } else {
        format!("its coordinates are only f32: {coarseness}; export it from the run that made it")
    };
    observer.say(format_args!("note: {note}"));
    in_frame(Frame::WORLD)
}

/// Writes a model in another format, and tells the observer what the format and the coordinates change. An error leaves
/// an existing file as it is.
///
/// # Errors
/// When the format cannot hold the model or its coordinates, or the disk fails.
pub fn write_model(
    format: &Format,
    path: &Path,
    model: &Gaussians,
    coordinates: Coordinates,
    observer: &dyn Observer,
) -> Result<(), Failure> {
    let (model, frame) = in_coordinates_of_file(model, coordinates, format, observer)?;
    write_in_frame(format, path, &model, frame, observer)?;
    say_unstated(format, path, frame, model.antialiasing, observer);
    Ok(())
}

/// Tells the user what a file cannot state itself: a kernel of antialiasing, or the offset of local coordinates.
pub fn say_unstated(
    format: &Format,
    path: &Path,
    frame: Frame,
    antialiasing: Antialiasing,
    observer: &dyn Observer,
) {
    if !format.states_antialiasing(antialiasing) {
        observer.say(format_args!(
            "note: {} cannot state the kernel of the antialiasing, {antialiasing}; readers assume 0.3 px², which \
             makes small Gaussians fainter; the other formats state it",
            format.name
        ));
    }
    if frame.offset().is_some() && !format.states_offset() {
        observer.say(format_args!(
            "note: the offset of the local coordinates is in {}; keep both files together",
            sidecar_path(path).display()
        ));
    }
}

/// Writes a model in another format. The model must have its coordinates in `frame`. Tells the observer what the format
/// changes. An error leaves an existing file as it is.
///
/// # Errors
/// When the format cannot hold the model, or the disk fails.
pub fn write_in_frame(
    format: &Format,
    path: &Path,
    model: &Gaussians,
    frame: Frame,
    observer: &dyn Observer,
) -> Result<(), Failure> {
    let write = |out: &mut dyn Write| {
        format.write_in(frame, model, out).map_err(|error| match error {
            // The format cannot hold the model; the disk is not at fault.
            error if is_unfit(&error) => WriteError::Source(Failure::input(error)),
            error => WriteError::Io(error),
        })
    };
    format.write_checked(path, frame, write, |written| {
        let (name, changes) = (format.name, format.changes(model, written)?);
        if changes.is_unfit() {
            // The file is discarded, so that the caller can try another format.
            let other = fitting_format(model, written).name;
            return Err(Failure::input(format!(
                "{name} cannot hold this model: {changes}; choose another format, such as {other}"
            )));
        }
        if changes.is_noted() {
            observer.say(format_args!("note: {name}: {changes}; ply and glb hold all values"));
        }
        Ok(())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_have_as_few_parts_as_needed_to_differ() {
        let names = |paths: &[&str]| names_of(&paths.iter().map(Path::new).collect::<Vec<_>>());
        assert_eq!(names(&["/home/me/out/a", "/home/me/out/b"]), ["a", "b"]);
        assert_eq!(names(&["/x/one/run", "/x/two/run", "/x/b"]), ["one/run", "two/run", "b"]);
        assert_eq!(names(&["/x/one/run", "/y/one/run"]), ["x/one/run", "y/one/run"]);
        assert_eq!(names(&["/run", "/x/run"]), ["/run", "x/run"]);
        // The same path twice has the same name.
        assert_eq!(names(&["/x/run", "/x/run"]), ["run", "run"]);
        assert_eq!(names(&["/x/a\u{1b}[1m"]), ["a\\u{1b}[1m"]);
    }
}
