//! The journal of a study: a file with a line per finished run, so that no run is repeated.

use std::fs;
use std::path::{Path, PathBuf};

use super::outcome::Outcome;
use densify_core::files::{FileError, write_atomically};
use densify_run::Partial;
use densify_run::failure::Failure;

/// The outcomes of the finished runs.
pub(super) struct Journal {
    path: PathBuf,
    outcomes: Vec<Outcome>,
}

impl Journal {
    /// Reads the journal, which need not exist. An incomplete last line is ignored, and its run repeated.
    pub(super) fn open(path: &Path) -> Result<Self, Failure> {
        let text = match fs::read_to_string(path) {
            Ok(text) => text,
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => String::new(),
            Err(e) => return Err(Failure::input(format!("{}: {e}", path.display()))),
        };
        let whole = text.rfind('\n').map_or("", |end| &text[..end]);
        let outcomes = (1..).zip(whole.lines()).map(|(number, line)| {
            serde_json::from_str(line).map_err(|e| {
                let place = format!("{}, line {number}", path.display());
                Failure::input(format!("{place}: {e}; delete the line to repeat its run"))
            })
        });
        Ok(Self { path: path.to_owned(), outcomes: outcomes.collect::<Result<_, _>>()? })
    }

    /// The outcome of the run with this description, by this version of densify.
    pub(super) fn outcome(&self, spec: &Partial) -> Option<&Outcome> {
        self.outcomes.iter().rev().find(|run| run.is_of(spec))
    }

    /// All outcomes, in the order in which the runs ended.
    pub(super) fn outcomes(&self) -> impl Iterator<Item = &Outcome> + Clone {
        self.outcomes.iter()
    }

    /// A finished run of this version of densify that has this name, but another description.
    pub(super) fn other_run(&self, name: &str, spec: &Partial) -> Option<&Outcome> {
        let is_current = |run: &&Outcome| run.densify == env!("CARGO_PKG_VERSION");
        let last = self.outcomes.iter().rev().filter(is_current).find(|run| run.run == name);
        last.filter(|run| !run.is_of(spec))
    }

    /// Adds an outcome and writes the file.
    pub(super) fn add(&mut self, outcome: Outcome) -> Result<(), FileError> {
        self.outcomes.push(outcome);
        write_atomically(&self.path, |out| {
            for outcome in &self.outcomes {
                serde_json::to_writer(&mut *out, outcome)?;
                out.write_all(b"\n")?;
            }
            Ok(())
        })
    }
}
