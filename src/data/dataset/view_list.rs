//! View lists: files that name the views to use, or parts of views.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use super::{LoadError, Part, View};
use densify_core::files;

/// Largest view list `[bytes]`; it has room for millions of names.
const MAX_BYTES: u64 = 1 << 30;
/// Separator between a name and a part.
const TAB: char = '\t';

/// The views of a photograph that a list names, cropped to the listed parts; all views if there is no list. `None` if
/// no view is left.
pub(super) fn select(list: Option<&mut ViewList>, views: Vec<View>) -> Option<Vec<View>> {
    let Some(list) = list else { return Some(views) };
    let select = |view: View| {
        let part = list.part(&view.name)?;
        Some(if let Some(part) = part { view.windowed(&part) } else { view })
    };
    let views: Vec<View> = views.into_iter().filter_map(select).collect();
    (!views.is_empty()).then_some(views)
}

/// A view list, with a record of the names that exist.
pub(super) struct ViewList {
    file: PathBuf,
    entries: HashMap<String, Entry>,
}

/// A line of a view list.
struct Entry {
    /// Line number, from 1.
    line: usize,
    /// The part of the view that is used; `None`: the whole view.
    part: Option<Part>,
    /// True if the dataset has a view of this name.
    exists: bool,
}

impl ViewList {
    /// Reads a file with one view per line: its name, optionally followed by a tab and the part that is used.
    pub(super) fn read(file: &Path) -> Result<Self, LoadError> {
        let text =
            files::read_text(file, MAX_BYTES).map_err(|error| fault(file, error.to_string()))?;
        let lines = text.lines().map(str::trim).zip(1..).filter(|(text, _)| !text.is_empty());
        let entries = lines.map(|(text, line)| {
            let (name, part) = match text.split_once(TAB) {
                None => (text, None),
                Some((name, part)) => (name.trim_end(), Some(part.parse().map_err(|_| line)?)),
            };
            Ok((name.to_owned(), Entry { line, part, exists: false }))
        });
        let entries = entries.collect::<Result<_, usize>>().map_err(|line| {
            let problem = format!(
                "line {line}: the tab must be followed by left, top, right and bottom of the part that is \
                 used, as fractions of the image from 0 to 1, such as `0.25 0 1 0.5`"
            );
            fault(file, problem)
        })?;
        Ok(Self { file: file.to_owned(), entries })
    }

    /// The part of a view that is used, `Some(None)` for the whole view; `None` if the view is not listed.
    fn part(&mut self, name: &str) -> Option<Option<Part>> {
        let entry = self.entries.get_mut(name)?;
        entry.exists = true;
        Some(entry.part)
    }

    /// Checks that every listed view exists and that one is left to train on.
    pub(super) fn check(&self, train: &[View]) -> Result<(), LoadError> {
        let missing = self.entries.iter().filter(|(_, entry)| !entry.exists);
        if let Some((name, Entry { line, .. })) = missing.min_by_key(|(_, entry)| entry.line) {
            let problem = format!(
                "line {line}: there is no view `{}`; the names of all views are in cameras.json of a run",
                files::one_line(name)
            );
            return Err(fault(&self.file, problem));
        }
        if train.is_empty() {
            let problem = format!(
                "none of the {} listed views is trained on; list others, or hold out fewer views",
                self.entries.len()
            );
            return Err(fault(&self.file, problem));
        }
        Ok(())
    }
}

fn fault(file: &Path, problem: String) -> LoadError {
    LoadError::ViewList { file: file.to_owned(), problem }
}

/// The line of a view list for a view, or for a part of it.
pub fn view_line(name: &str, part: Option<Part>) -> String {
    let part = part.map_or_else(String::new, |part| format!("{TAB}{part}"));
    format!("{name}{part}\n")
}
