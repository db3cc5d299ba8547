//! `--resume`: what a run goes on from, and with which options.
//!
//! The saved description is overlaid with what this call gives. What would give another result than the
//! saved one is refused by name.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use toml::{Table, Value};

use super::Partial;
use super::config::RunConfig;
use super::observer::Observer;
use super::records::SavedSession;
use super::resolve::{Begun, Known};
use super::spec::{OnResume, RunOption, RunSpec};
use crate::failure::Failure;
use densify_data::views::DatasetViews;
use densify_train::checkpoint::{Checkpoint, CheckpointError, Fingerprint, newest};
use densify_train::output::{CONFIG_FILE, RunFolder, saved_iterations};
use densify_train::trainer::Trainer;

/// A run that goes on.
pub struct Resumed {
    /// `None`: the run was stopped before its first checkpoint, and begins again.
    pub(super) checkpoint: Option<Checkpoint>,
    /// The run as it was.
    pub(super) config: RunConfig,
    /// The step at which it ends: its length, or what it is extended to.
    pub(super) last: u32,
}

impl Resumed {
    /// The file that says how the run began.
    fn origin(&self, output: &Path) -> PathBuf {
        let config = || output.join(CONFIG_FILE);
        self.checkpoint.as_ref().map_or_else(config, |checkpoint| checkpoint.path().to_owned())
    }

    /// What need not be found out again.
    pub(super) fn known(&self) -> Known<'_> {
        let exposures = match self.checkpoint {
            Some(_) => Begun::Kept,
            None => Begun::Anew,
        };
        Known { config: &self.config, exposures }
    }

    /// Steps done.
    pub(super) fn step(&self) -> u32 {
        self.checkpoint.as_ref().map_or(0, |checkpoint| checkpoint.header().trainer.step)
    }
}

/// Options within the table of knobs that change no byte of the result, or are compared as what came of
/// them.
const FREE_KNOBS: [&str; 2] = ["knob.pairs_per_row", "knob.accumulation"];

/// Looks in the output folder that `given` describes for the newest sound checkpoint, or else for the
/// description of a run that has none yet, and lays `given` over the options that were saved with it.
/// Where there is neither, there is nothing to lose, and the run starts anew.
///
/// # Errors
/// When a process is training there, the folder holds a run that can no longer go on, or what is there
/// cannot be used.
pub fn start(
    given: Partial,
    observer: &dyn Observer,
) -> Result<(RunSpec, Option<Resumed>), Failure> {
    let described = given.clone().describe()?;
    let output = described.output_folder()?;
    RunFolder::check(&output, true)?;
    RunFolder::settle(&output)?;
    if let Some(staged) = RunFolder::staged(&output).iter().find(|path| newest(path).0.is_some()) {
        return Err(Failure::input(format!(
            "--resume: {} holds a run that was to replace the one there and was interrupted: {}; \
             go on with it by naming that folder with -o, or remove it",
            output.display(),
            staged.display()
        )));
    }
    let (checkpoint, rejected) = newest(&output);
    let config = match &checkpoint {
        Some(checkpoint) => {
            for error in &rejected {
                observer.say(format_args!("note: a newer checkpoint cannot be used: {error}"));
            }
            let origin = format!("{}: its configuration", checkpoint.path().display());
            RunConfig::from_table(checkpoint.header().config.clone(), &origin)?
        }
        None => {
            nothing(&output, &rejected, observer)?;
            if !output.join(CONFIG_FILE).exists() {
                return Ok((described, None));
            }
            RunConfig::read(&output)?
        }
    };
    let mut resumed = Resumed { checkpoint, last: config.last(), config };
    let origin = resumed.origin(&output).display().to_string();
    let length = resumed.config.spec.schedule.iterations.0;
    if let Some(asked) = given.get("iterations").and_then(Value::as_integer) {
        resumed.last = u32::try_from(asked).unwrap_or(resumed.last);
    }
    if resumed.last < length.max(resumed.step()) {
        return Err(Failure::input(format!(
            "--iterations {} contradicts {origin}: that run has {length} iterations, of which {} \
             are done; it can be extended, not shortened",
            resumed.last,
            resumed.step(),
        )));
    }
    let mut spec = overlay(given, &resumed.config, &origin)?;
    spec.schedule.iterations.0 = length;
    // It is this folder that goes on, wherever it was when the run began.
    spec.output.output = Some(output);
    Ok((spec, Some(resumed)))
}

/// The saved options under those that are given.
fn overlay(mut given: Partial, saved: &RunConfig, origin: &str) -> Result<RunSpec, Failure> {
    let mut lower = Partial::all(&saved.spec)?;
    // `auto` is what was decided then.
    for name in ["budget", "sh_degree"] {
        let is_auto = |value: &Value| value.as_str().is_some_and(|text| text.starts_with("auto"));
        match (given.get(name).and_then(Value::as_str), lower.get(name)) {
            (Some("auto"), Some(saved)) if is_auto(saved) => given.remove(name),
            (Some("auto"), Some(saved)) => {
                let flag = RunOption::find(name).map_or_else(String::new, RunOption::flag);
                return Err(Failure::input(format!(
                    "--resume: {flag} auto contradicts {origin}, which was given {saved}; leave it out, \
                     or begin a new run without --resume"
                )));
            }
            _ => {}
        }
    }
    // Where this call says where to compute, or how sums are made, that is compared with the run
    // when the device is open.
    if given.get("backend").is_some() || given.get("gpu").is_some() {
        lower.remove("gpu");
        lower.remove("backend");
        lower = Partial::setting("accumulation", "auto").over(lower);
    }
    if given.get("deterministic").is_some() {
        lower = Partial::setting("accumulation", "auto").over(lower);
    }
    // How the dataset is split can be said in two ways.
    if given.get("test_every").is_some() {
        lower.remove("eval");
    } else if given.get("eval").is_some() {
        lower.remove("test_every");
    }
    if given.get("preset").is_some() {
        let name = given.get("preset").and_then(Value::as_str).unwrap_or_default();
        given = given.clone().over(Partial::preset(name)?);
    }
    // Parameters of one policy mean nothing to another one, which is refused later.
    if given.get("policy").is_some_and(|it| it.as_str() != Some(&saved.spec.density.policy)) {
        lower.remove("policy_set");
    }
    given.over(lower).spec()
}

/// There is no sound checkpoint in the folder.
fn nothing(
    output: &Path,
    rejected: &[CheckpointError],
    observer: &dyn Observer,
) -> Result<(), Failure> {
    let folder = output.display();
    if !rejected.is_empty() {
        let why: Vec<String> = rejected.iter().map(|error| format!("\n  {error}")).collect();
        return Err(Failure::input(format!(
            "--resume: no checkpoint in {folder} can be used:{}\nto begin anew, leave --resume out \
             and give --overwrite",
            why.concat()
        )));
    }
    if saved_iterations(output).is_ok() {
        return Err(Failure::input(format!(
            "--resume: {folder} holds a run, but no checkpoint to go on from; to begin anew, leave \
             --resume out and give --overwrite, or choose another folder with -o"
        )));
    }
    observer
        .say(format_args!("note: {folder} holds no checkpoint yet; the run begins at its start"));
    Ok(())
}

/// Fails where this run would give another result than the saved one, or has another dataset.
pub(super) fn check(
    now: &RunConfig,
    resumed: &Resumed,
    dataset: &Fingerprint,
    output: &Path,
) -> Result<(), Failure> {
    let path = resumed.origin(output);
    let path = path.display();
    let (ours, theirs) = (fixed(now)?, fixed(&resumed.config)?);
    let same_policy = now.spec.density.policy == resumed.config.spec.density.policy;
    let mut keys: Vec<&String> = ours.keys().chain(theirs.keys()).collect();
    keys.sort();
    keys.dedup();
    let shown = |value: Option<&String>| value.map_or("not set", String::as_str).to_owned();
    let problems: Vec<String> = keys
        .into_iter()
        .filter(|key| same_policy || !key.starts_with("policy_set."))
        .map(|key| (key, ours.get(key), theirs.get(key)))
        .filter(|(_, ours, theirs)| ours != theirs)
        .map(|(key, ours, theirs)| {
            let (ours, theirs) = (shown(ours), shown(theirs));
            format!("\n  {}: {ours} now, {theirs} in that run", flag(key))
        })
        .collect();
    if !problems.is_empty() {
        return Err(Failure::input(format!(
            "--resume: this call contradicts {path}:{}\nleave these options out, or begin a new run \
             without --resume",
            problems.concat()
        )));
    }
    let saved = resumed.checkpoint.as_ref().map(|checkpoint| &checkpoint.header().dataset);
    match saved.and_then(|saved| saved.difference(dataset)) {
        None => Ok(()),
        Some(difference) => Err(Failure::input(format!(
            "--resume: this is not the dataset of {path}: {difference}; give the dataset of that run, \
             or begin a new run without --resume"
        ))),
    }
}

/// The option that a key of [`fixed`] is.
fn flag(key: &str) -> String {
    let (option, rest) = key.split_once('.').unwrap_or((key, ""));
    let flag = match (RunOption::find(option), rest) {
        (_, "adapter") => return "--gpu".to_owned(),
        (_, "accumulation") => return "--knob accumulation".to_owned(),
        (Some(option), _) => option.flag(),
        (None, _) => option.to_owned(),
    };
    format!("{flag} {rest}").trim().to_owned()
}

/// Every setting that a resumed run must have as it was, by its path, as text.
fn fixed(config: &RunConfig) -> Result<BTreeMap<String, String>, Failure> {
    fn walk(prefix: &str, table: &Table, found: &mut BTreeMap<String, String>) {
        for (key, value) in table {
            let path = if prefix.is_empty() { key.clone() } else { format!("{prefix}.{key}") };
            match value {
                Value::Table(inner) => walk(&path, inner, found),
                leaf => _ = found.insert(path, leaf.to_string()),
            }
        }
    }
    let mut table = config.spec.table()?;
    table.retain(|name, _| {
        RunOption::find(name).is_some_and(|option| option.on_resume == OnResume::Fixed)
    });
    let mut found = BTreeMap::new();
    walk("", &table, &mut found);
    found.retain(|key, _| !FREE_KNOBS.contains(&&**key));
    let resolved =
        [("adapter", &config.resolved.adapter), ("accumulation", &config.resolved.accumulation)];
    for (name, value) in resolved {
        let value = value.clone().unwrap_or_else(|| "the processor".to_owned());
        found.insert(format!("resolved.{name}"), value);
    }
    Ok(found)
}

/// Gives the trainer, which holds as many rows as the checkpoint, everything that is in it; the session
/// is `None` where there is no checkpoint.
pub(super) fn restore(
    resumed: Resumed,
    trainer: &mut Trainer<DatasetViews>,
    observer: &dyn Observer,
) -> Result<Option<SavedSession>, Failure> {
    let (step, last) = (resumed.step(), resumed.last);
    let length = resumed.config.spec.schedule.iterations.0;
    let session = match resumed.checkpoint {
        Some(checkpoint) => Some(restore_from(checkpoint, trainer, observer)?),
        None => None,
    };
    if last > length {
        observer.say(format_args!(
            "note: extended from {length} to {last} iterations; all schedules stay those of {length}, \
             and learning rates no longer fall beyond it"
        ));
    }
    if step >= last {
        observer.say(format_args!(
            "note: all {last} iterations are done; --iterations with a larger number extends the run"
        ));
    }
    Ok(session)
}

fn restore_from(
    mut checkpoint: Checkpoint,
    trainer: &mut Trainer<DatasetViews>,
    observer: &dyn Observer,
) -> Result<SavedSession, Failure> {
    checkpoint.restore(trainer.backend())?;
    let header = checkpoint.header();
    let fail =
        |problem: String| Failure::input(format!("{}: {problem}", checkpoint.path().display()));
    let state = header.trainer.clone();
    let step = state.step;
    trainer.resume(state).map_err(|error| fail(error.to_string()))?;
    let session = serde_json::from_value(header.session.clone());
    let session = session.map_err(|error| fail(format!("its session: {error}")))?;
    observer.say(format_args!("resume   from step {step}, {}", checkpoint.path().display()));
    let version = env!("CARGO_PKG_VERSION");
    if header.densify != version {
        observer.say(format_args!(
            "note: the checkpoint was written by densify {}, this is {version}; the result may differ \
             from that of a run that was not interrupted",
            header.densify
        ));
    }
    Ok(session)
}
