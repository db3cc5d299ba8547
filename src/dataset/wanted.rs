//! `--views`: a file that names the views to use.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use super::{DatasetError, View};
use crate::foreign;

/// Most bytes of such a file: millions of names.
const MAX_BYTES: u64 = 1 << 30;

/// Those of a photograph's views that are wanted; `None` where none is.
pub(super) fn of(wanted: &mut Option<Wanted>, mut views: Vec<View>) -> Option<Vec<View>> {
    let Some(wanted) = wanted else { return Some(views) };
    views.retain(|view| wanted.has(&view.name));
    (!views.is_empty()).then_some(views)
}

/// The names in a file, and which of them are views.
pub(super) struct Wanted {
    file: PathBuf,
    /// By name: the line, from 1, and whether there is such a view.
    names: HashMap<String, (usize, bool)>,
}

impl Wanted {
    /// Reads a name from each line that is not empty.
    pub(super) fn read(file: &Path) -> Result<Self, DatasetError> {
        let text = foreign::read_text(file, MAX_BYTES)
            .map_err(|error| DatasetError(format!("--views {}: {error}", file.display())))?;
        let lines = text.lines().map(str::trim).enumerate().filter(|(_, name)| !name.is_empty());
        let names = lines.map(|(line, name)| (name.to_owned(), (line + 1, false))).collect();
        Ok(Self { file: file.to_owned(), names })
    }

    fn has(&mut self, name: &str) -> bool {
        let found = self.names.get_mut(name);
        found.map(|(_, is_there)| *is_there = true).is_some()
    }

    /// Fails where a line names no view, or none is left to train on.
    pub(super) fn check(&self, train: &[View]) -> Result<(), DatasetError> {
        let file = self.file.display();
        let missing = self.names.iter().filter(|(_, (_, is_there))| !is_there);
        if let Some((name, (line, _))) = missing.min_by_key(|(_, (line, _))| *line) {
            return Err(DatasetError(format!(
                "--views {file}: line {line}: there is no view `{}`; names are those in cameras.json of a run",
                foreign::one_line(name)
            )));
        }
        if train.is_empty() {
            return Err(DatasetError(format!(
                "--views {file}: none of the {} views that it names is trained on; name others, or hold out \
                 fewer",
                self.names.len()
            )));
        }
        Ok(())
    }
}
