//! nerfstudio's lists of the frames to train on, to validate with and to test on.
//!
//! Only the frames listed for training are trained on; if there is no such list, all frames that no other list names
//! are trained on. Test views are the frames listed for tests or, if there are none, those listed for validation. A
//! frame listed for validation is trained on only if it is listed for training, too.

use std::collections::HashMap;
use std::path::PathBuf;

use super::LoadError;
use super::folders::{Folders, ImageFile};
use super::paths::{DataPath, relative};

/// The lists, in the order of [`FrameLists::lists`].
pub(super) const FIELDS: [&str; 3] = ["train_filenames", "val_filenames", "test_filenames"];

/// The names in a list by the image that each refers to; true if a frame has this image.
type Names = HashMap<PathBuf, (String, bool)>;

/// The lists of a file, and how its frames are used according to them.
#[derive(Debug, Default)]
pub(super) struct FrameLists {
    lists: [Option<Names>; 3],
    /// Frames that are not used, because no list names them.
    unlisted: Vec<String>,
    /// Frames that are not used, because only the list for validation names them.
    validation: Vec<String>,
    /// Frames that are both trained on and tested on.
    both: Vec<String>,
    /// Number of frames whose image exists.
    frames: usize,
    /// Number of these frames that are trained on.
    trained: usize,
}

/// The key of a frame: its image or, if that is missing, the path as listed.
fn key(value: &str, found: Option<&ImageFile>) -> PathBuf {
    found.map_or_else(|| relative(&value.replace('\\', "/")).into(), |found| found.path.clone())
}

impl FrameLists {
    /// Adds the list in the field `FIELDS[list]`.
    pub(super) fn add(
        &mut self,
        folders: &Folders,
        list: usize,
        names: &[DataPath<'_>],
    ) -> Result<(), LoadError> {
        let mut keyed = Names::new();
        for &named in names {
            let found = folders.image(named)?;
            keyed.insert(key(named.value, found.as_ref()), (named.value.to_owned(), false));
        }
        self.lists[list] = Some(keyed);
        Ok(())
    }

    /// Two flags: the frame is trained on; it is tested on.
    pub(super) fn splits(&mut self, file: &str, found: Option<&ImageFile>) -> (bool, bool) {
        let key = key(file, found);
        let [train, validation, test] = self.lists.each_mut().map(|list| {
            let entry = list.as_mut().and_then(|names| names.get_mut(&key));
            entry.map(|(_, matched)| *matched = true).is_some()
        });
        let has_train = self.lists[0].is_some();
        let tested = if self.names_any(2) { test } else { validation };
        let trained = if has_train { train } else { !(validation || test) };
        if found.is_some() {
            self.frames += 1;
            self.trained += usize::from(trained);
            let group = match (trained, tested) {
                (true, true) => Some(&mut self.both),
                (false, false) if validation => Some(&mut self.validation),
                (false, false) => Some(&mut self.unlisted),
                _ => None,
            };
            group.into_iter().for_each(|group| group.push(file.to_owned()));
        }
        (trained, tested)
    }

    fn names_any(&self, list: usize) -> bool {
        self.lists[list].as_ref().is_some_and(|names| !names.is_empty())
    }

    /// The first list that defines which frames are tested on. An empty validation or test list defines none.
    fn defining_list(&self) -> Option<usize> {
        (0..3).find(|&list| self.names_any(list) || list == 0 && self.lists[0].is_some())
    }

    /// Returns true if the lists define which frames are tested on.
    pub(super) fn define_the_split(&self) -> bool {
        self.defining_list().is_some()
    }

    /// The field that is wrong and its problem: a name that no frame has, or no frame to train on.
    pub(super) fn fault(&self) -> Option<(&'static str, String)> {
        for (field, names) in FIELDS.iter().zip(&self.lists) {
            let unmatched = || names.iter().flat_map(HashMap::values).filter(|(_, used)| !used);
            if let Some(name) = unmatched().map(|(name, _)| name).min() {
                let more = match unmatched().count() - 1 {
                    0 => String::new(),
                    more => format!(", and {more} more names match no frame"),
                };
                let problem = format!("no frame has the file_path {name:?}{more}");
                return Some((field, problem));
            }
        }
        let leaves_none = self.trained == 0 && self.frames > 0;
        let problem = || "it leaves no frame to train on".to_owned();
        self.defining_list().filter(|_| leaves_none).map(|list| (FIELDS[list], problem()))
    }

    /// Notes for the user about frames that would be used differently without lists.
    pub(super) fn notes(&self, file: &str) -> Vec<String> {
        let mut notes = Vec::new();
        let mut note = |group: &[String], words: &str| {
            if let Some(first) = group.first() {
                let (count, all) = (group.len(), self.frames);
                notes.push(format!("{file}: {count} of {all} frames {words} (first: {first})"));
            }
        };
        note(&self.unlisted, "are in no list of filenames and are not used");
        note(&self.validation, "are held out for validation: neither trained on nor tested");
        note(
            &self.both,
            "are listed both for training and for tests, so their scores do not measure unseen views",
        );
        if self.lists[0].is_some() && !self.names_any(1) && !self.names_any(2) {
            notes.push(format!(
                "{file}: frames are listed for training and none for tests, so no view is held out"
            ));
        }
        notes
    }
}
