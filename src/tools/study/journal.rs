//! The file of records of a study: a line for everything that is finished, so that it is not done again.

use std::fs;
use std::path::{Path, PathBuf};

use super::record::Outcome;
use densify_core::files::{FileError, write_atomically};
use densify_run::Partial;
use densify_run::failure::Failure;

/// The records in a file.
pub(super) struct Journal {
    path: PathBuf,
    records: Vec<Outcome>,
}

impl Journal {
    /// Reads what is there. A last line that was cut off is not: its run runs again.
    pub(super) fn open(path: &Path) -> Result<Self, Failure> {
        let text = match fs::read_to_string(path) {
            Ok(text) => text,
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => String::new(),
            Err(e) => return Err(Failure::input(format!("{}: {e}", path.display()))),
        };
        let whole = text.rfind('\n').map_or("", |end| &text[..end]);
        let mut records = Vec::new();
        for (i, line) in whole.lines().enumerate() {
            records.push(serde_json::from_str(line).map_err(|e| {
                Failure::input(format!(
                    "{}, line {}: {e}; delete the line, and its run runs again",
                    path.display(),
                    i + 1
                ))
            })?);
        }
        Ok(Self { path: path.to_owned(), records })
    }

    /// The outcome of the run with this description, by this version of densify.
    pub(super) fn outcome(&self, spec: &Partial) -> Option<&Outcome> {
        self.records.iter().rev().find(|run| run.is_of(spec))
    }

    /// Adds a record and writes them all.
    pub(super) fn add(&mut self, record: Outcome) -> Result<(), FileError> {
        self.records.push(record);
        let lines = self.records.iter().map(|r| serde_json::to_string(r).map(|line| line + "\n"));
        write_atomically(&self.path, |out| {
            for line in lines {
                out.write_all(line.map_err(std::io::Error::other)?.as_bytes())?;
            }
            Ok(())
        })
    }
}
