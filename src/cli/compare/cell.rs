//! One run of a comparison, and the record that it leaves.

use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use toml::{Table, Value};

use super::contender::Contender;
use super::{POINTS, run_folder};
use crate::cli::study::{Call, Entry, Summary, has_geometry, in_run};
use crate::failure::Failure;
use crate::metrics::geometry::Geometry;
use crate::number::grouped;
use crate::output::{Mean, geometry_of};
use crate::run::Partial;

/// What is run.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Cell {
    pub(super) scene: PathBuf,
    pub(super) label: String,
    /// A [`Contender`].
    pub(super) policy: String,
    pub(super) budget: usize,
    pub(super) seed: u32,
    pub(super) iterations: u32,
    /// Options that all runs share.
    pub(super) train: Partial,
}

impl fmt::Display for Cell {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { label, policy, budget, seed, .. } = self;
        write!(f, "{label}, {policy}, {} rows, seed {seed}", grouped(*budget))
    }
}

/// A line of `compare.jsonl`: what came of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Record {
    /// Version of densify.
    pub(super) densify: String,
    pub(super) scene: String,
    pub(super) policy: String,
    pub(super) budget: usize,
    pub(super) seed: u32,
    pub(super) iterations: u32,
    /// Folder of the run, in `runs`.
    pub(super) run: String,
    /// The run's description: one with the same is not run again.
    pub(super) spec: Table,
    /// Mean over the views held out `[dB]`.
    pub(super) psnr: f64,
    /// Mean over the views held out.
    pub(super) ssim: f64,
    /// Mean over the views held out: FLIP error.
    pub(super) flip: f64,
    /// Rows at the end.
    pub(super) rows: usize,
    /// Most rows at any instant.
    pub(super) peak_rows: usize,
    /// Largest resident memory of the process.
    pub(super) peak_bytes: Option<u64>,
    /// Wall time of the steps.
    pub(super) seconds: f64,
    /// Processor time of the steps.
    pub(super) cpu_seconds: Option<f64>,
    /// Views rendered for the policy's decisions.
    pub(super) extra_forwards: u64,
    /// (iteration, PSNR) along the run.
    pub(super) curve: Vec<(u32, f64)>,
    /// How the model sits on the surface, where that is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) geometry: Option<Geometry>,
}

impl Record {
    /// Whether the budget was kept at every instant.
    pub(super) fn is_bounded(&self) -> bool {
        self.peak_rows <= self.budget
    }
}

impl Entry for Record {
    type Of = Cell;

    fn is_of(&self, cell: &Cell) -> bool {
        self.spec == cell.spec() && self.densify == env!("CARGO_PKG_VERSION")
    }
}

impl Cell {
    /// The description of the run.
    fn spec(&self) -> Table {
        let tests = (1..POINTS).map(|i| i64::from((self.iterations * i / POINTS).max(1)));
        let own = [
            ("scene", Value::from(self.scene.to_string_lossy().into_owned())),
            ("budget", Value::from(i64::try_from(self.budget).unwrap_or(i64::MAX))),
            ("seed", Value::from(self.seed)),
            ("iterations", Value::from(self.iterations)),
            ("test_iterations", Value::from(tests.collect::<Vec<_>>())),
        ];
        let own = own.into_iter().fold(self.train.clone(), |spec, (name, value)| {
            Partial::option(name, value).over(spec)
        });
        Contender::new(&self.policy).options().over(own).into_table()
    }

    fn run(&self) -> String {
        let Self { label, policy, budget, seed, .. } = self;
        format!("{label}-{}-{budget}-seed{seed}", Contender::new(policy).folder())
    }

    /// Runs it.
    ///
    /// # Errors
    /// With the trainer's message and exit code when it fails.
    pub(super) fn train(&self, output: &Path) -> Result<Record, Failure> {
        let run = self.run();
        let folder = output.join("runs").join(&run);
        let spec = self.spec();
        let call = Call { spec: &spec, folder: &folder };
        let done = call.train().and_then(|()| match has_geometry(&self.scene) {
            true => call.measure(),
            false => Ok(()),
        });
        done.map_err(|failure| in_run(self, failure))?;
        self.record(&folder, run)
    }

    fn record(&self, folder: &Path, run: String) -> Result<Record, Failure> {
        let summary = Summary::read(folder)?;
        let Summary { ref tests, .. } = summary;
        let Some((_, &Mean { psnr, ssim, flip })) = tests.last_key_value() else {
            return Err(Failure::input(format!(
                "{}: no view is held out to measure",
                self.scene.display()
            )));
        };
        Ok(Record {
            densify: summary.text("densify"),
            scene: self.label.clone(),
            policy: self.policy.clone(),
            budget: self.budget,
            seed: self.seed,
            iterations: self.iterations,
            run,
            spec: self.spec(),
            psnr,
            ssim,
            flip,
            rows: summary.number("rows")? as usize,
            peak_rows: summary.number("peak_rows")? as usize,
            peak_bytes: summary.get("peak_bytes").as_u64(),
            seconds: summary.number("seconds")?,
            cpu_seconds: summary.get("cpu_seconds").as_f64(),
            extra_forwards: summary.number("extra_forwards")? as u64,
            curve: tests.iter().map(|(step, mean)| (*step, mean.psnr)).collect(),
            geometry: geometry_of(folder, self.iterations)?,
        })
    }
}

/// (iteration, value) of a field of the run's log; nothing where it has none.
pub(super) fn over_time(output: &Path, record: &Record, field: &str) -> Vec<(u32, f64)> {
    let path = run_folder(output, record).join("stats/train.jsonl");
    let text = fs::read_to_string(path).unwrap_or_default();
    let steps =
        text.lines().filter_map(|line| serde_json::from_str::<serde_json::Value>(line).ok());
    let point = |step: serde_json::Value| {
        let iteration = u32::try_from(step["step"].as_u64()?).ok()?;
        Some((iteration, step[field].as_f64()?))
    };
    steps.filter_map(point).collect()
}
