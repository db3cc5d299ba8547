//! Lists of the photographs to train on and to test on, which other programs put beside COLMAP models.
//!
//! `test.txt` beside the model is that of the original trainer and of Hierarchical 3D Gaussians; `train_list.txt` and
//! `test_list.txt` in the dataset's folder are those of NerfBaselines. All have a name per line.

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};

use super::super::paths::{DataPath, Root, relative};
use super::super::{Frame, LoadError};
use densify_core::files;

/// Largest list `[bytes]`; it has room for a million names.
const MAX_BYTES: u64 = 256 << 20;
const TESTS: &str = "test.txt";
const LISTS: [&str; 2] = ["train_list.txt", "test_list.txt"];
const REMEDY: &str = "repair or remove the list, or hold out every Kth photograph instead";

/// A list of photographs.
struct List {
    path: PathBuf,
    /// The path as messages show it.
    shown: String,
    /// Indices of the frames that it names.
    frames: HashSet<usize>,
}

/// Divides the frames of a model according to the lists beside it (`model` and `folder`: the model's root and folder) or
/// in the dataset's folder; returns true if there are lists. A single list leaves the other frames to the other split; of
/// two lists, frames in neither are removed.
///
/// # Errors
/// When a list names none of the photographs, or leaves none to train on.
pub(super) fn apply(
    root: &Root,
    (model, folder): (&Root, &Path),
    frames: &mut Vec<Frame>,
    notes: &mut Vec<String>,
) -> Result<bool, LoadError> {
    let names = Names::new(frames);
    let beside = List::read(model, &folder.join(TESTS), &names, notes)?;
    let (train, test) = match beside {
        Some(test) => (None, Some(test)),
        None => {
            let mut list = |name: &str| List::read(root, &root.path().join(name), &names, notes);
            (list(LISTS[0])?, list(LISTS[1])?)
        }
    };
    let Some(last) = test.as_ref().or(train.as_ref()) else { return Ok(false) };
    let all = frames.len();
    let is_trained = |index: usize| match (&train, &test) {
        (Some(train), _) => train.frames.contains(&index),
        (None, test) => !test.as_ref().is_some_and(|test| test.frames.contains(&index)),
    };
    let is_tested = |index: usize| match (&train, &test) {
        (_, Some(test)) => test.frames.contains(&index),
        (train, None) => !train.as_ref().is_some_and(|train| train.frames.contains(&index)),
    };
    let count = |is: &dyn Fn(usize) -> bool| (0..all).filter(|&index| is(index)).count();
    let tested = count(&is_tested);
    if count(&is_trained) == 0 {
        let problem = "it leaves no photograph to train on";
        return Err(LoadError::malformed(&last.path, "the list", problem, REMEDY));
    }
    notes.push(match &test {
        Some(test) => format!("{} holds out {tested} of {all} photographs", test.shown),
        None => format!(
            "{} does not list {tested} of {all} photographs, which are held out",
            last.shown
        ),
    });
    let mut note = |count: usize, words: &str| {
        if count > 0 {
            notes.push(format!("{count} of {all} photographs {words}"));
        }
    };
    note(count(&|i| !is_trained(i) && !is_tested(i)), "are in neither list and are not used");
    note(
        count(&|i| is_trained(i) && is_tested(i)),
        "are listed both for training and for tests, so their scores do not measure unseen views",
    );
    let divided = std::mem::take(frames).into_iter().enumerate().flat_map(|(index, frame)| {
        let trained = is_trained(index).then(|| frame.clone());
        let tested = is_tested(index).then_some(Frame { held_out: true, ..frame });
        trained.into_iter().chain(tested)
    });
    *frames = divided.collect();
    Ok(true)
}

impl List {
    /// Reads the list at `path`, if there is one with names. Names without a photograph are noted: COLMAP does not find the poses
    /// of all photographs.
    fn read(
        root: &Root,
        path: &Path,
        names: &Names,
        notes: &mut Vec<String>,
    ) -> Result<Option<Self>, LoadError> {
        if !path.is_file() {
            return Ok(None);
        }
        let shown = path.strip_prefix(root.path()).unwrap_or(path).to_string_lossy().into_owned();
        root.existing(DataPath { file: path, field: "the list", value: &shown })?;
        let text = files::read_text(path, MAX_BYTES).map_err(LoadError::io(path))?;
        if text.trim().is_empty() {
            return Ok(None);
        }
        let lines = text.lines().map(str::trim).filter(|line| !line.is_empty());
        let (mut frames, mut unknown) = (HashSet::new(), Vec::new());
        for line in lines {
            match names.find(line) {
                Some(index) => _ = frames.insert(index),
                None => unknown.push(line),
            }
        }
        match unknown.first() {
            Some(first) if frames.is_empty() => {
                let problem =
                    format!("it names none of the model's photographs (first: {first:?})");
                return Err(LoadError::malformed(path, "the list", problem, REMEDY));
            }
            Some(first) => notes.push(files::one_line(&format!(
                "{shown}: {} of {} names are not in the model and are skipped (first: {first})",
                unknown.len(),
                unknown.len() + frames.len()
            ))),
            None => {}
        }
        Ok(Some(Self { path: path.to_owned(), shown, frames }))
    }
}

/// The frames by the names of their images as listed in the model, with and without file extension.
struct Names {
    whole: HashMap<String, usize>,
    /// `None` for names that several images have.
    stems: HashMap<String, Option<usize>>,
}

impl Names {
    fn new(frames: &[Frame]) -> Self {
        let (mut whole, mut stems) = (HashMap::new(), HashMap::new());
        for (index, frame) in frames.iter().enumerate() {
            whole.insert(frame.listed.clone(), index);
            let stem = stem(&frame.listed).to_owned();
            stems.entry(stem).and_modify(|entry| *entry = None).or_insert(Some(index));
        }
        Self { whole, stems }
    }

    /// The frame of a listed name, which may have another extension, none, or the folder `images`.
    fn find(&self, line: &str) -> Option<usize> {
        let name = relative(&line.replace('\\', "/"));
        let inside = name.strip_prefix("images/").unwrap_or(&name);
        let whole = |name: &str| self.whole.get(name).copied();
        let named = |name: &str| self.stems.get(name).copied().flatten();
        [&*name, inside]
            .into_iter()
            .find_map(|name| whole(name).or_else(|| named(name)).or_else(|| named(stem(name))))
    }
}

/// The name without its extension.
fn stem(name: &str) -> &str {
    let file = name.rfind('/').map_or(0, |slash| slash + 1);
    name[file..].rfind('.').filter(|&dot| dot > 0).map_or(name, |dot| &name[..file + dot])
}
