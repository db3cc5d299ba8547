//! `--resume`: which checkpoint a run goes on from, and with which options.
//!
//! Options that are not given are those of the checkpoint. They become words of the command line,
//! so that they pass the same checks: a checkpoint is a file like any other. Options that are given
//! must not contradict it, but for those that change nothing in the result.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::path::{Path, PathBuf};

use clap::{ArgMatches, FromArgMatches};
use toml::{Table, Value};

use super::TrainArgs;
use super::choices::default_output;
use super::spelling::{self, command, given_knobs, id, is_given};
use super::tally::is_in_use;
use crate::checkpoint::{Checkpoint, newest};
use crate::cli::console::Console;
use crate::cli::device::Where;
use crate::cli::failure::Failure;
use crate::output::{InitChoice, RunConfig, RunFolder, saved_iterations};

/// A run that goes on.
pub(super) struct Resumed {
    pub(super) checkpoint: Checkpoint,
    /// The step at which it ends: its length, or what it is extended to.
    pub(super) last: u32,
}

/// How a call with `--resume` starts.
pub(super) enum Start {
    /// There is nothing yet to go on from, and nothing to lose.
    Anew,
    /// From a checkpoint, with all options.
    From(Box<(TrainArgs, Resumed)>),
}

/// Settings in `config.toml` that change no byte of the result.
const FREE: [&str; 8] = [
    "densify",
    "scene.path",
    "scene.working_directory",
    "scene.images",
    "scene.image_cache",
    "train.tile_cap",
    "train.extended_to",
    "knobs.pairs_per_row",
];

/// Looks for the checkpoint. `words` are those after `train` on the command line, which `args` was
/// parsed from.
pub(super) fn start(
    words: &[OsString],
    args: &TrainArgs,
    console: &Console,
) -> Result<Start, Failure> {
    let output = output(args);
    if let Some(staged) = RunFolder::staged(&output).iter().find(|path| newest(path).0.is_some()) {
        return Err(Failure::input(format!(
            "--resume: {} holds a run that was to replace the one there and was interrupted: {}; \
             go on with it by naming that folder with -o, or remove it",
            output.display(),
            staged.display()
        )));
    }
    if is_in_use(&output) {
        return Err(Failure::input(format!(
            "--resume: another process is training in {}; wait for it, or stop it",
            output.display()
        )));
    }
    let (checkpoint, rejected) = newest(&output);
    let Some(checkpoint) = checkpoint else {
        return nothing(&output, &rejected, console);
    };
    for error in &rejected {
        console.say(format_args!("note: a newer checkpoint is left aside: {error}"));
    }
    let saved = &checkpoint.header().config;
    let step = checkpoint.header().trainer.step;
    let words = spelling::spelled(words, Some(&saved.policy.name))?;
    let given = spelling::matches(&words)?;
    let all = adopted(saved, &given)?.into_iter().chain(words);
    let matches = command().try_get_matches_from(all);
    let args = matches.and_then(|matches| TrainArgs::from_arg_matches(&matches));
    let mut args = args.map_err(|error| {
        let problem = error.to_string();
        let problem = problem.trim().trim_start_matches("error: ");
        Failure::input(format!("{}: its configuration: {problem}", checkpoint.path().display()))
    })?;
    let length = saved.train.iterations;
    let last = if is_given(&given, "iterations") {
        args.iterations
    } else {
        saved.train.extended_to.unwrap_or(length).max(length)
    };
    if last < length.max(step) {
        return Err(Failure::input(format!(
            "--iterations {last} contradicts {}: that run has {length} iterations, of which {step} \
             are done; it can be extended, not shortened",
            checkpoint.path().display()
        )));
    }
    args.iterations = length;
    Ok(Start::From(Box::new((args, Resumed { checkpoint, last }))))
}

/// Where a run of these options goes.
pub(super) fn output(args: &TrainArgs) -> PathBuf {
    args.output.clone().unwrap_or_else(|| default_output(&args.scene, &args.policy))
}

/// There is no sound checkpoint in the folder.
fn nothing(
    output: &Path,
    rejected: &[crate::checkpoint::CheckpointError],
    console: &Console,
) -> Result<Start, Failure> {
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
    console
        .say(format_args!("note: {folder} holds no checkpoint yet; the run begins at its start"));
    Ok(Start::Anew)
}

/// The options of a saved run that are not given, as words.
fn adopted(saved: &RunConfig, given: &ArgMatches) -> Result<Vec<OsString>, Failure> {
    let RunConfig { scene, train, policy, knobs, .. } = saved;
    let mut words: Vec<OsString> = Vec::new();
    let mut adopt = |flag: &str, value: Option<OsString>| {
        if let Some(value) = value.filter(|_| !is_given(given, &id(flag))) {
            // One word, so that a value that begins with a dash is none of an option.
            let mut word = OsString::from(format!("{flag}="));
            word.push(value);
            words.push(word);
        }
    };
    let text = |value: &dyn ToString| Some(OsString::from(value.to_string()));
    adopt("--policy", text(&policy.name));
    adopt("--budget", text(&train.budget));
    adopt("--memory", train.memory.and_then(|bytes| text(&bytes)));
    adopt("--iterations", text(&train.iterations));
    adopt("--seed", text(&train.seed));
    adopt("--sh-degree", text(&train.sh_degree));
    adopt("--near", text(&train.near));
    adopt("--tile-cap", train.tile_cap.and_then(|cap| text(&cap)));
    adopt("--sh-every", train.sh_every.and_then(|every| text(&every)));
    adopt("--init-points", train.init_points.and_then(|points| text(&points)));
    let init = match train.init {
        InitChoice::Points => "points",
        InitChoice::Random => "random",
    };
    adopt("--init", text(&init));
    adopt("--images", scene.images.clone().map(PathBuf::into_os_string));
    adopt("--resolution", scene.resolution.and_then(|resolution| text(&resolution)));
    adopt("--image-cache", text(&scene.image_cache));
    adopt("--background", text(&scene.background));
    if !is_given(given, "backend") && !is_given(given, "gpu") {
        match &train.adapter {
            Some(name) => adopt("--gpu", text(name)),
            None => adopt("--backend", text(&"cpu")),
        }
    }
    let split = is_given(given, "eval") || is_given(given, "test_every");
    if !split {
        adopt("--test-every", scene.test_every.and_then(|every| text(&every)));
        if scene.eval && scene.test_every.is_none() {
            words.push("--eval".into());
        }
    }
    if train.full && !is_given(given, "full") {
        words.push("--full".into());
    }
    // Settings that are given come after these and win.
    let rates = Table::try_from(train.learning_rates).unwrap_or_default();
    words.extend(rates.iter().map(|(name, rate)| format!("--lr={name}={rate}").into()));
    // Parameters of one policy are none of another one, which is refused later.
    let name = &policy.name;
    let another = is_given(given, "policy") && given.get_one("policy") != Some(name);
    if !another && !is_given(given, "policy_config") {
        let set = policy.parameters.iter();
        words.extend(set.map(|(key, value)| format!("--policy-set={name}.{key}={value}").into()));
    }
    // Where this call says how sums are made, or that there is no GPU, `check` compares with the run.
    let on_processor = given.get_one("backend") == Some(&Where::Cpu) && is_given(given, "backend");
    let says_sums = on_processor || is_given(given, "deterministic");
    let given = given_knobs(given)?;
    let knobs = knobs.completed(train.adapter.is_some());
    let kept = knobs.iter().filter(|(name, _)| {
        given.iter().all(|(knob, _)| knob.name != *name) && !(says_sums && *name == "accumulation")
    });
    words.extend(kept.map(|(name, value)| format!("--knob={name}={value}").into()));
    Ok(words)
}

/// Fails where the configuration of this call would give another result than the saved one.
pub(super) fn check(now: &RunConfig, checkpoint: &Checkpoint) -> Result<(), Failure> {
    let saved = &checkpoint.header().config;
    let knobs = saved.knobs.completed(saved.train.adapter.is_some());
    let (mut ours, mut theirs) = (leaves(now), leaves(&RunConfig { knobs, ..saved.clone() }));
    for free in FREE {
        ours.remove(free);
        theirs.remove(free);
    }
    if now.policy.name != saved.policy.name {
        for settings in [&mut ours, &mut theirs] {
            settings.retain(|key, _| !key.starts_with("policy.parameters."));
        }
    }
    let mut keys: Vec<&String> = ours.keys().chain(theirs.keys()).collect();
    keys.sort();
    keys.dedup();
    let shown = |value: Option<&String>| value.map_or("not set", String::as_str).to_owned();
    let problems: Vec<String> = keys
        .into_iter()
        .map(|key| (key, ours.get(key), theirs.get(key)))
        .filter(|(_, ours, theirs)| ours != theirs)
        .map(|(key, ours, theirs)| {
            let (ours, theirs) = (shown(ours), shown(theirs));
            format!("\n  {}: {ours} now, {theirs} in the checkpoint", flag(key, &now.policy.name))
        })
        .collect();
    if problems.is_empty() {
        return Ok(());
    }
    Err(Failure::input(format!(
        "--resume: this call contradicts {}:{}\nleave these options out, or begin a new run without \
         --resume",
        checkpoint.path().display(),
        problems.concat()
    )))
}

/// The option that a setting of `config.toml` comes from.
fn flag(key: &str, policy: &str) -> String {
    let (table, name) = key.split_once('.').unwrap_or(("", key));
    match (table, name) {
        ("policy", "name") => "--policy".to_owned(),
        ("policy", name) => match name.strip_prefix("parameters.") {
            Some(parameter) => format!("--policy-set {policy}.{parameter}"),
            None => key.to_owned(),
        },
        ("knobs", name) => format!("--knob {name}"),
        ("train", "adapter") => "--gpu".to_owned(),
        ("train", name) => match name.strip_prefix("learning_rates.") {
            Some(rate) => format!("--lr {rate}"),
            None => format!("--{}", name.replace('_', "-")),
        },
        (_, name) => format!("--{}", name.replace('_', "-")),
    }
}

/// Every setting by its path, as text.
fn leaves(config: &RunConfig) -> BTreeMap<String, String> {
    fn walk(prefix: &str, table: &Table, found: &mut BTreeMap<String, String>) {
        for (key, value) in table {
            let path = if prefix.is_empty() { key.clone() } else { format!("{prefix}.{key}") };
            match value {
                Value::Table(inner) => walk(&path, inner, found),
                leaf => _ = found.insert(path, leaf.to_string()),
            }
        }
    }
    let mut found = BTreeMap::new();
    walk("", &Table::try_from(config).unwrap_or_default(), &mut found);
    found
}
