//! The file of records of a study: a line per run that is finished, so that it is not run again.

use std::fs;
use std::path::{Path, PathBuf};

use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::failure::Failure;
use crate::output::{OutputError, write_atomically};

/// A record of something that was done.
pub(in crate::cli) trait Entry: Serialize + DeserializeOwned {
    /// What is done.
    type Of;

    /// Whether this is the record of that, and it need not be done again.
    fn is_of(&self, what: &Self::Of) -> bool;
}

/// The records in a file.
pub(in crate::cli) struct Records<R> {
    path: PathBuf,
    all: Vec<R>,
}

impl<R: Entry> Records<R> {
    /// Reads what is there. A last line that was cut off is not: its run runs again.
    ///
    /// # Errors
    /// When a line is no record.
    pub(in crate::cli) fn open(path: &Path) -> Result<Self, Failure> {
        let text = match fs::read_to_string(path) {
            Ok(text) => text,
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => String::new(),
            Err(e) => return Err(Failure::input(format!("{}: {e}", path.display()))),
        };
        let whole = text.rfind('\n').map_or("", |end| &text[..end]);
        let mut all = Vec::new();
        for (i, line) in whole.lines().enumerate() {
            all.push(serde_json::from_str(line).map_err(|e| {
                Failure::input(format!(
                    "{}, line {}: {e}; delete the line, and its run runs again",
                    path.display(),
                    i + 1
                ))
            })?);
        }
        Ok(Self { path: path.to_owned(), all })
    }

    /// The record of what is done already.
    pub(in crate::cli) fn of(&self, what: &R::Of) -> Option<&R> {
        self.all.iter().rev().find(|record| record.is_of(what))
    }

    /// Adds a record and writes them all.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub(in crate::cli) fn add(&mut self, record: R) -> Result<(), OutputError> {
        self.all.push(record);
        let text = self.all.iter().map(|r| serde_json::to_string(r).map(|line| line + "\n"));
        write_atomically(&self.path, |out| {
            for line in text {
                out.write_all(line.map_err(std::io::Error::other)?.as_bytes())?;
            }
            Ok(())
        })
    }
}
