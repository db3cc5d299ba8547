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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::outcome::sample;

    #[test]
    fn outcomes_are_read_back_and_told_apart_by_their_descriptions() {
        let root = tempfile::tempdir().unwrap();
        let path = root.path().join("compare.jsonl");
        let spec = |seed: i64| Partial::option("seed", seed);
        let run = |seed: i64, psnr: f64| Outcome {
            densify: env!("CARGO_PKG_VERSION").into(),
            run: "room".into(),
            spec: spec(seed).into_table(),
            curve: vec![(1, psnr)],
            ssim: 1.0,
            flip: 0.0,
            ..sample("diet", "1000", 0, psnr)
        };
        // A view that equals its photograph has an infinite PSNR.
        let all = [run(0, 30.0), run(1, f64::INFINITY)];
        let mut journal = Journal::open(&path).unwrap();
        all.iter().for_each(|outcome| journal.add(outcome.clone()).unwrap());
        let text = fs::read_to_string(&path).unwrap();
        fs::write(&path, format!("{text}{{\"densify\":")).unwrap();
        let journal = Journal::open(&path).unwrap();
        assert!(journal.outcomes().eq(&all));
        assert_eq!(journal.outcome(&spec(1)), Some(&all[1]));
        assert_eq!(journal.outcome(&spec(2)), None);
        // Runs of one name share a folder on disk, which holds the last of them; only that one counts.
        assert_eq!(journal.other_run("room", &spec(0)), Some(&all[1]));
        assert_eq!(journal.other_run("room", &spec(1)), None);
        assert_eq!(journal.other_run("cup", &spec(0)), None);
    }
}
