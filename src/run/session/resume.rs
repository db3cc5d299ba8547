//! `--resume`: the checkpoint that a run is resumed from, and its options.
//!
//! The saved description is overlaid with the options of this call. Options that would change the result are refused by
//! name.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use toml::Value;

use super::records::SavedSession;
use crate::failure::{Difference, Failure, ResumeProblem, notes};
use crate::observer::Observer;
use crate::resolved::RunConfig;
use crate::spec::{Assignment, OnResume, Partial, RunOption, RunSpec, assignments};
use densify_data::views::DatasetViews;
use densify_train::checkpoint::{Checkpoint, CheckpointError, Fingerprint, newest};
use densify_train::output::{CONFIG_FILE, RunFolder, saved_iterations};
use densify_train::trainer::Trainer;

/// A run to resume.
pub struct Resumed {
    /// The newest usable checkpoint; `None`: the run was stopped before its first checkpoint, and starts over.
    pub(super) checkpoint: Option<Checkpoint>,
    /// The configuration that was saved.
    pub(super) config: RunConfig,
    /// The step at which the run ends, beyond its original length if it is extended.
    pub(super) last: u32,
}

impl Resumed {
    /// The file that contains the saved description.
    fn origin(&self, output: &Path) -> PathBuf {
        let config = || output.join(CONFIG_FILE);
        self.checkpoint.as_ref().map_or_else(config, |checkpoint| checkpoint.path().to_owned())
    }

    /// Number of steps done.
    pub(super) fn step(&self) -> u32 {
        self.checkpoint.as_ref().map_or(0, |checkpoint| checkpoint.header().trainer.step)
    }
}

/// Knobs that do not change the result, or whose resolved value is compared instead.
const FREE_KNOBS: [&str; 2] = ["knob.pairs_per_row", "knob.accumulation"];

/// Finds the newest usable checkpoint in the output folder of `given`, or else the configuration of a run without
/// checkpoints, and overlays the saved options with `given`. If there is neither, the run is new.
///
/// # Errors
/// When a process is training in the folder, or the run in the folder cannot be resumed.
pub fn start(
    given: Partial,
    observer: &dyn Observer,
) -> Result<(RunSpec, Option<Resumed>), Failure> {
    let described = given.clone().describe()?;
    let output = described.output_folder()?;
    RunFolder::check(&output, true)?;
    RunFolder::recover(&output)?;
    let staged = RunFolder::staged(&output);
    if let Some(staged) = staged.into_iter().find(|path| newest(path).0.is_some()) {
        return Err(ResumeProblem::InterruptedReplacement { output, staged }.into());
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
            check_restart(&output, &rejected, observer)?;
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
        let (asked, done) = (resumed.last, resumed.step());
        return Err(ResumeProblem::Shortened { asked, origin, length, done }.into());
    }
    let mut spec = overlay(given, &resumed.config, &origin)?;
    spec.schedule.iterations.0 = length;
    say_what_is_assumed(&resumed.config, &spec, observer);
    // The folder may have been moved since the run began.
    spec.output.output = Some(output);
    Ok((spec, Some(resumed)))
}

/// Tells the user the values of parameters that the saved run lacks, as they were added to its policy later.
fn say_what_is_assumed(saved: &RunConfig, now: &RunSpec, observer: &dyn Observer) {
    for assumed in &saved.assumed {
        let set = now.density.policy_set.iter().find(|set| set.path == assumed.path);
        if let Some(Assignment { path, value }) = set {
            let path = path.join(".");
            let value = value.as_str().map_or_else(|| value.to_string(), str::to_owned);
            observer.say(format_args!(
                "note: the run was saved before {path} existed; it goes on with {path}={value}"
            ));
        }
    }
}

/// Overlays the saved options with those that are given.
fn overlay(mut given: Partial, saved: &RunConfig, origin: &str) -> Result<RunSpec, Failure> {
    // Training needs the policies of the saved run.
    let mut lower = Partial::given(&saved.spec, |_| true)?;
    // `auto` stands for the decision that was saved.
    for option in ["budget", "sh_degree"] {
        let is_auto = |value: &Value| value.as_str().is_some_and(|text| text.starts_with("auto"));
        match (given.get(option).and_then(Value::as_str), lower.get(option)) {
            (Some("auto"), Some(saved)) if is_auto(saved) => given.remove(option),
            (Some("auto"), Some(saved)) => {
                let (origin, saved) = (origin.to_owned(), saved.to_string());
                return Err(ResumeProblem::AutoOnResume { option, origin, saved }.into());
            }
            _ => {}
        }
    }
    // The folder of a run is accepted in place of the saved path, which names a model in it.
    for option in ["init", "freeze"] {
        let path =
            |options: &Partial| options.get(option).and_then(Value::as_str).map(PathBuf::from);
        if path(&given).zip(path(&lower)).is_some_and(|(given, saved)| saved.starts_with(given)) {
            given.remove(option);
        }
    }
    // A device or an accumulation that this call chooses is compared with that of the saved run once the device is
    // open.
    if given.get("backend").is_some() || given.get("gpu").is_some() {
        lower.remove("gpu");
        lower.remove("backend");
        lower = Partial::setting("accumulation", "auto").over(lower);
    }
    if given.get("deterministic").is_some() {
        lower = Partial::setting("accumulation", "auto").over(lower);
    }
    // Either of two options splits the dataset; the one that is given replaces the other.
    if given.get("test_every").is_some() {
        lower.remove("eval");
    } else if given.get("eval").is_some() {
        lower.remove("test_every");
    }
    if given.get("preset").is_some() {
        let name = given.get("preset").and_then(Value::as_str).unwrap_or_default();
        given = given.clone().over(Partial::preset(name)?);
    }
    // Parameters of one policy mean nothing to another policy; a change of policy is refused later.
    if given.get("policy").is_some_and(|policy| policy.as_str() != Some(&saved.spec.density.policy))
    {
        lower.remove("policy_set");
    }
    given.over(lower).spec()
}

/// Fails if the folder, which has no usable checkpoint, holds a run that must not start over.
fn check_restart(
    output: &Path,
    rejected: &[CheckpointError],
    observer: &dyn Observer,
) -> Result<(), Failure> {
    if !rejected.is_empty() {
        let errors = rejected.iter().map(CheckpointError::to_string).collect();
        return Err(ResumeProblem::NoSoundCheckpoint { output: output.to_owned(), errors }.into());
    }
    if saved_iterations(output).is_ok() {
        return Err(ResumeProblem::NoCheckpoint { output: output.to_owned() }.into());
    }
    let folder = output.display();
    observer
        .say(format_args!("note: {folder} holds no checkpoint yet; the run begins at its start"));
    Ok(())
}

/// Tells the user if the policy may decide otherwise than before, as it depends on other programs or its file has
/// changed.
pub(super) fn note_provenance(now: &RunConfig, resumed: &Resumed, observer: &dyn Observer) {
    if let (Some(now), Some(saved)) = (&now.resolved.policy, &resumed.config.resolved.policy)
        && now != saved
    {
        observer.say(format_args!(
            "note: the policy was {saved}, and is now {now}; results may differ"
        ));
    }
}

/// Fails if the result of this run would differ from that of the saved run, or if their datasets differ.
pub(super) fn check(
    now: &RunConfig,
    resumed: &Resumed,
    dataset: &Fingerprint,
    output: &Path,
) -> Result<(), Failure> {
    let origin = resumed.origin(output);
    let (current, original) = (fixed(now)?, fixed(&resumed.config)?);
    // What the saved run lacks may be stated now.
    let is_assumed = |key: &str| {
        let mut assumed = resumed.config.assumed.iter();
        let parameter = key.strip_prefix("policy_set.");
        assumed.any(|assumed| parameter.is_some_and(|name| assumed.path.join(".") == name))
    };
    let same_policy = now.spec.density.policy == resumed.config.spec.density.policy;
    let keys: BTreeSet<&String> = current.keys().chain(original.keys()).collect();
    let differences: Vec<Difference> = keys
        .into_iter()
        .filter(|key| same_policy || !key.starts_with("policy_set."))
        .filter(|key| current.get(*key) != original.get(*key) && !is_assumed(key))
        .map(|key| difference(key, current.get(key), original.get(key)))
        .collect();
    if !differences.is_empty() {
        return Err(ResumeProblem::ResultWouldDiffer { origin, differences }.into());
    }
    let saved = resumed.checkpoint.as_ref().map(|checkpoint| &checkpoint.header().dataset);
    match saved.and_then(|saved| saved.difference(dataset)) {
        None => Ok(()),
        Some(difference) => Err(ResumeProblem::OtherDataset { origin, difference }.into()),
    }
}

/// A difference in a key of [`fixed`], under the name of the option that sets the key.
fn difference(key: &str, now: Option<&String>, then: Option<&String>) -> Difference {
    let (option, member) = key.split_once('.').unwrap_or((key, ""));
    let (option, member) = match member {
        "adapter" => ("gpu", ""),
        "accumulation" => ("knob", "accumulation"),
        _ => (option, member),
    };
    let (option, member) = (option.to_owned(), member.to_owned());
    Difference { option, member, now: now.cloned(), then: then.cloned() }
}

/// Every setting that a resumed run must keep: its path, and its value as text.
fn fixed(config: &RunConfig) -> Result<BTreeMap<String, String>, Failure> {
    let mut table = config.spec.table()?;
    table.retain(|name, _| {
        RunOption::find(name).is_some_and(|option| option.on_resume == OnResume::Fixed)
    });
    let settings =
        assignments(&table).into_iter().map(|set| (set.path.join("."), set.value.to_string()));
    let mut settings: BTreeMap<_, _> = settings.collect();
    settings.retain(|key, _| !FREE_KNOBS.contains(&&**key));
    let resolved =
        [("adapter", &config.resolved.adapter), ("accumulation", &config.resolved.accumulation)];
    for (name, value) in resolved {
        let value = value.clone().unwrap_or_else(|| "the processor".to_owned());
        settings.insert(format!("resolved.{name}"), value);
    }
    Ok(settings)
}

/// Restores the trainer, which has as many rows as the checkpoint, and returns the state of the session; `None` without
/// a checkpoint.
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
            "note: extended from {length} to {last} iterations; schedules remain those of {length} \
             iterations, after which learning rates stay constant"
        ));
    }
    if step >= last {
        observer.say(format_args!("{}", notes::all_done(observer.spelling(), last)));
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
