//! Choices that clap cannot check: parameters of policies, learning rates, iterations, names.

use std::path::{Path, PathBuf};

use densify_policies::parameters::parse_overrides;
use densify_policies::policy::RateOverrides;
use densify_policies::registry::{PolicyEntry, find};
use toml::Table;

use super::TrainArgs;
use crate::cli::failure::Failure;
use crate::schedule::RateOptions;

/// The policy's parameters as set by file and flags.
pub(super) fn parameters(args: &TrainArgs, entry: &PolicyEntry) -> Result<Table, Failure> {
    let mut set = Table::new();
    if let Some(path) = &args.policy_config {
        let fail = |problem: String| {
            Failure::input(format!("--policy-config {}: {problem}", path.display()))
        };
        let text = std::fs::read_to_string(path).map_err(|e| fail(e.to_string()))?;
        let file: Table = text.parse().map_err(|e| fail(format!("{e}").trim().to_owned()))?;
        for (policy, table) in file {
            // One file may serve several policies; a misspelt name may not pass for another one.
            let known = find(&policy).map_err(|e| fail(e.to_string()))?;
            let Ok(table) = table.try_into::<Table>() else {
                return Err(fail(format!("`{policy}` must be a table: [{policy}]")));
            };
            if known.name == entry.name {
                set = table;
            }
        }
    }
    let overrides = parse_overrides(&args.policy_set)
        .map_err(|error| Failure::input(format!("--policy-set: {error}")))?;
    for (policy, table) in overrides {
        if find(&policy)?.name != entry.name {
            return Err(Failure::input(format!(
                "--policy-set sets a parameter of `{policy}`, but the policy of this run is `{}`; \
                 choose it with --policy {policy}",
                entry.name
            )));
        }
        set.extend(table);
    }
    Ok(set)
}

/// Default learning rates for so many iterations, overlaid with the policy's, and these with
/// `NAME=RATE` settings, which are taken as given.
pub(super) fn learning_rates(
    settings: &[String],
    iterations: u32,
    of_policy: &RateOverrides,
) -> Result<RateOptions, Failure> {
    let defaults = Table::try_from(RateOptions::for_run(iterations).with(of_policy));
    let mut table = defaults.map_err(|e| Failure::input(format!("--lr: {e}")))?;
    for setting in settings {
        let value = setting
            .split_once('=')
            .and_then(|(name, rate)| Some((name.trim(), rate.trim().parse::<f64>().ok()?)));
        let Some((name, rate)) = value else {
            return Err(Failure::input(format!(
                "--lr {setting} is not of the form NAME=RATE, such as opacity=0.05"
            )));
        };
        table.insert(name.to_owned(), rate.into());
    }
    let fail = |problem: &str| Failure::input(format!("--lr: {}", problem.trim()));
    let rates: RateOptions = table.try_into().map_err(|e| fail(&e.to_string()))?;
    match rates.invalid() {
        Some(name) => Err(fail(&format!("{name} must be a positive number"))),
        None => Ok(rates),
    }
}

pub(super) fn check_iterations(flag: &str, chosen: &[u32], iterations: u32) -> Result<(), Failure> {
    match chosen.iter().find(|&&n| n == 0 || n > iterations) {
        None => Ok(()),
        Some(n) => Err(Failure::input(format!(
            "{flag} {n} is out of range: the run has iterations 1 to {iterations}"
        ))),
    }
}

/// `output/SCENE-POLICY`, SCENE being the dataset folder's name.
pub(super) fn default_output(scene: &Path, policy: &str) -> PathBuf {
    if let Some(name) = crate::dataset::builtin::name(scene) {
        return Path::new("output").join(format!("{name}-{policy}"));
    }
    let full = scene.canonicalize().unwrap_or_else(|_| scene.to_owned());
    let name = full.file_name().map_or_else(|| "scene".into(), |name| name.to_string_lossy());
    Path::new("output").join(format!("{name}-{policy}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    const PLAIN: RateOverrides = RateOverrides { mean_start: None, mean_end: None, sh_rest: None };

    #[test]
    fn learning_rates_by_name() {
        let rates =
            learning_rates(&["opacity=0.05".into(), "mean_end = 1e-5".into()], 30_000, &PLAIN)
                .unwrap();
        let expected = RateOptions { opacity: 0.05, mean_end: 1e-5, ..RateOptions::default() };
        assert_eq!(rates, expected);
        let of_policy =
            RateOverrides { mean_end: Some(3e-6), sh_rest: Some(2e-4), ..RateOverrides::default() };
        let both = learning_rates(&["mean_end=1e-5".into()], 30_000, &of_policy).unwrap();
        let expected = RateOptions { mean_end: 1e-5, sh_rest: 2e-4, ..RateOptions::default() };
        assert_eq!(both, expected);
        for (bad, part) in [
            ("opacity", "NAME=RATE"),
            ("opacity=x", "NAME=RATE"),
            ("colour=1", "colour"),
            ("quat=0", "quat"),
            ("quat=inf", "quat"),
        ] {
            let message = learning_rates(&[bad.into()], 30_000, &PLAIN).unwrap_err().message;
            assert!(message.contains(part) && message.contains("--lr"), "{bad}: {message}");
        }
    }

    #[test]
    fn iterations_outside_the_run_name_the_flag() {
        assert!(check_iterations("--save-iterations", &[1, 30], 30).is_ok());
        for bad in [0, 31] {
            let failure = check_iterations("--save-iterations", &[5, bad], 30).unwrap_err();
            assert!(failure.message.starts_with(&format!("--save-iterations {bad} ")));
        }
    }

    #[test]
    fn the_output_is_named_after_the_scene_and_the_policy() {
        let root = tempfile::tempdir().unwrap();
        let scene = root.path().join("garden");
        std::fs::create_dir(&scene).unwrap();
        for spelling in [scene.clone(), scene.join(""), scene.join("."), scene.join("../garden")] {
            assert_eq!(default_output(&spelling, "diet"), Path::new("output/garden-diet"));
        }
    }
}
