//! `--views`: a file that names the views to use, and what of them.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use super::{DatasetError, Part, View};
use densify_core::files;

/// Most bytes of such a file: millions of names.
const MAX_BYTES: u64 = 1 << 30;
/// What stands between a name and a part.
const TAB: char = '\t';

/// Those of a photograph's views that are wanted; `None` where none is.
pub(super) fn of(wanted: &mut Option<Wanted>, views: Vec<View>) -> Option<Vec<View>> {
    let Some(wanted) = wanted else { return Some(views) };
    let cut = |view: View| {
        let part = wanted.part(&view.name)?;
        Some(if let Some(part) = part { view.windowed(&part) } else { view })
    };
    let views: Vec<View> = views.into_iter().filter_map(cut).collect();
    (!views.is_empty()).then_some(views)
}

/// The names in a file, and which of them are views.
pub(super) struct Wanted {
    file: PathBuf,
    /// By name.
    names: HashMap<String, Named>,
}

/// What a line says.
struct Named {
    /// From 1.
    line: usize,
    /// The part of the view that is used, if not all.
    part: Option<Part>,
    /// Whether there is such a view.
    is_there: bool,
}

impl Wanted {
    /// Reads a name from each line that is not empty, and the part of the view behind a tab, if there is one.
    pub(super) fn read(file: &Path) -> Result<Self, DatasetError> {
        let text = files::read_text(file, MAX_BYTES)
            .map_err(|error| DatasetError(format!("--views {}: {error}", file.display())))?;
        let lines = text.lines().map(str::trim).zip(1..).filter(|(text, _)| !text.is_empty());
        let named = lines.map(|(text, line)| {
            let (name, part) = match text.split_once(TAB) {
                None => (text, None),
                Some((name, part)) => (name.trim_end(), Some(part.parse().map_err(|_| line)?)),
            };
            Ok((name.to_owned(), Named { line, part, is_there: false }))
        });
        let names = named.collect::<Result<_, usize>>().map_err(|line| {
            DatasetError(format!(
                "--views {}: line {line}: behind the tab stand left, top, right and bottom of the part that is used, in \
                 parts of the image from 0 to 1, such as `0.25 0 1 0.5`",
                file.display()
            ))
        })?;
        Ok(Self { file: file.to_owned(), names })
    }

    /// The part of a view that is used, if that is not all; `None` where the view is not wanted.
    fn part(&mut self, name: &str) -> Option<Option<Part>> {
        let named = self.names.get_mut(name)?;
        named.is_there = true;
        Some(named.part)
    }

    /// Fails where a line names no view, or none is left to train on.
    pub(super) fn check(&self, train: &[View]) -> Result<(), DatasetError> {
        let file = self.file.display();
        let missing = self.names.iter().filter(|(_, named)| !named.is_there);
        if let Some((name, Named { line, .. })) = missing.min_by_key(|(_, named)| named.line) {
            return Err(DatasetError(format!(
                "--views {file}: line {line}: there is no view `{}`; names are those in cameras.json of a run",
                files::one_line(name)
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

/// The line that names a view, and the part of it that is used, if not all.
pub fn view_line(name: &str, part: Option<Part>) -> String {
    let part = part.map_or_else(String::new, |part| format!("{TAB}{part}"));
    format!("{name}{part}\n")
}
