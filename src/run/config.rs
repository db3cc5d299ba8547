//! `config.toml`: a run as it is, every option with its value, and what was found out when it was prepared.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use toml::{Table, Value};

use super::overlay::{FOUND_OUT, Partial};
use super::spec::RunSpec;
use super::values::ShDegree;
use crate::failure::Failure;
use densify_core::files::{FileError, write_atomically};
use densify_data::track_colours::Spread;
use densify_data::track_colours::exposures::ExposureSpread;
use densify_train::output::CONFIG_FILE;

/// A prepared run: its options, where all that was open is decided, and what decided it.
#[derive(Debug, Clone, PartialEq)]
pub struct RunConfig {
    /// Version of densify that made the run.
    pub densify: String,
    /// The run, with every option that preparing it decides. The same description makes the same run.
    pub spec: RunSpec,
    /// What was found out.
    pub resolved: Resolved,
}

/// What was found out when a run was prepared.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Resolved {
    /// The folder that relative paths start from.
    pub working_directory: Option<PathBuf>,
    /// The GPU adapter that trained; `None`: the processor.
    pub adapter: Option<String>,
    /// How a GPU added up gradients; `None`: the processor.
    pub accumulation: Option<String>,
    /// The iteration to which a resumed run was extended beyond its length. Schedules do not depend on
    /// it: learning rates stay at their end.
    pub extended_to: Option<u32>,
    /// What decided the degree.
    pub sh_degree_from: DegreeSource,
    /// Whether `--memory` has made the degree lower than was wanted.
    pub sh_degree_lowered: bool,
    /// What decided whether exposures are learned.
    pub exposure_from: ExposureSource,
    /// Whether they are.
    pub has_exposures: bool,
    /// The model that the run began from.
    pub init_model: Option<ModelSize>,
    /// The model whose Gaussians never change.
    pub frozen: Option<ModelSize>,
}

/// How large a model is that a file holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelSize {
    /// Its Gaussians.
    pub rows: usize,
    /// Its spherical-harmonic degree.
    pub sh_degree: u8,
}

/// What decided whether each photograph has an exposure of its own.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ExposureSource {
    /// The options.
    #[default]
    Given,
    /// The colours of tracks, before training.
    Tracks(ExposureSpread),
    /// Nothing: too few tracks are known, so exposures are not learned.
    Undecided,
}

/// What decided the spherical-harmonic degree of a run.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DegreeSource {
    /// The options.
    #[default]
    Given,
    /// The colours of tracks, before training.
    Spread(Spread),
    /// Nothing: too few tracks are known, so it is the highest.
    Undecided,
}

impl RunConfig {
    /// The content of `config.toml`.
    pub fn table(&self) -> Result<Table, Failure> {
        let mut table = self.spec.table()?;
        table.insert("densify".into(), self.densify.clone().into());
        let resolved = Table::try_from(&self.resolved).map_err(Failure::input)?;
        table.insert("resolved".into(), resolved.into());
        Ok(table)
    }

    /// Reads what [`table`](Self::table) wrote.
    ///
    /// # Errors
    /// Names the key, and what was expected.
    pub fn from_table(mut table: Table, origin: &str) -> Result<Self, Failure> {
        let fail = |problem: &str| Failure::input(format!("{origin}: {problem}"));
        let [densify, resolved] = FOUND_OUT.map(|key| table.remove(key));
        let Some(Value::String(densify)) = densify else {
            return Err(fail("`densify` must be a string, the version that wrote the file"));
        };
        let resolved = resolved.unwrap_or_else(|| Table::new().into());
        let resolved = Resolved::deserialize(resolved)
            .map_err(|error| fail(&format!("resolved: {}", error.to_string().trim())))?;
        let spec = Partial::new(table, origin)?.spec()?;
        let config = Self { densify, spec, resolved };
        match (config.spec.size.budget.and_then(super::Budget::most), config.spec.size.sh_degree) {
            (Some(_), Some(ShDegree::Fixed(_) | ShDegree::Auto(Some(_)))) => Ok(config),
            _ => Err(fail("`budget` and `sh_degree` must be numbers in the file of a run")),
        }
    }

    /// Writes `config.toml` into the run's folder.
    pub fn write(&self, run: &Path) -> Result<(), Failure> {
        let text = toml::to_string_pretty(&self.table()?).map_err(Failure::input)?;
        let path = run.join(CONFIG_FILE);
        write_atomically(&path, |out| out.write_all(text.as_bytes()))?;
        Ok(())
    }

    /// Reads the `config.toml` of a run.
    ///
    /// # Errors
    /// When there is none, or it does not say what it should.
    pub fn read(run: &Path) -> Result<Self, Failure> {
        let path = run.join(CONFIG_FILE);
        let text = densify_core::files::read_text(&path, densify_core::files::MAX_OPTIONS)
            .map_err(|error| match error.kind() {
                std::io::ErrorKind::NotFound => FileError::no_run(run, CONFIG_FILE).into(),
                _ => Failure::input(format!("cannot read {}: {error}", path.display())),
            })?;
        let malformed = |problem: String| Failure::from(FileError::malformed(&path, problem));
        let table: Table = text
            .parse()
            .map_err(|error: toml::de::Error| malformed(error.to_string().trim().into()))?;
        Self::from_table(table, &path.display().to_string())
    }

    /// The most rows there may ever be.
    #[must_use]
    pub fn budget(&self) -> usize {
        self.spec.size.budget.and_then(super::Budget::most).unwrap_or_default()
    }

    /// The highest spherical-harmonic degree.
    #[must_use]
    pub fn sh_degree(&self) -> u8 {
        match self.spec.size.sh_degree {
            Some(ShDegree::Fixed(degree) | ShDegree::Auto(Some(degree))) => degree,
            Some(ShDegree::Auto(None)) | None => densify_core::gaussians::MAX_SH_DEGREE,
        }
    }

    /// The step at which the run ends.
    #[must_use]
    pub fn last(&self) -> u32 {
        self.resolved.extended_to.unwrap_or(0).max(self.spec.schedule.iterations.0)
    }

    /// The dataset's folder: as given where that exists from here, else from the folder in which
    /// the run was started.
    #[must_use]
    pub fn scene_path(&self) -> PathBuf {
        let given = self.spec.start.scene.clone().unwrap_or_default();
        let from_there = self.resolved.working_directory.as_ref().map(|folder| folder.join(&given));
        from_there.filter(|path| path.exists()).unwrap_or(given)
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::{Assignment, Budget, ByteCount, InitChoice};
    use densify_train::schedule::Background;

    pub(crate) fn sample() -> RunConfig {
        let mut spec = RunSpec::default();
        spec.start.scene = Some("data/room".into());
        spec.start.init = Some(InitChoice::Points);
        spec.data.images = Some("elsewhere".into());
        spec.data.eval = true;
        spec.data.background = Background::Colour([255, 0, 16]);
        spec.size.budget = Some(Budget::Auto(Some(28_000)));
        spec.size.memory = Some(ByteCount(1 << 28));
        spec.size.sh_degree = Some(ShDegree::Auto(Some(3)));
        spec.schedule.seed = i64::MAX as u64;
        spec.schedule.knob = vec!["alpha_min=1/128".parse::<Assignment>().unwrap()];
        spec.density.policy_set = vec!["diet.rho=0.2".parse().unwrap()];
        let spread = Spread {
            tracks: 4_000,
            on_surface: 0.75,
            median: 0.5,
            tenth: 1.5,
            twentieth: 2.5,
            rms: 6.0,
        };
        let resolved =
            Resolved { sh_degree_from: DegreeSource::Spread(spread), ..Resolved::default() };
        RunConfig { densify: "0.1.0".into(), spec, resolved }
    }

    #[test]
    fn what_is_written_is_read_back() {
        let root = tempfile::tempdir().unwrap();
        sample().write(root.path()).unwrap();
        assert_eq!(RunConfig::read(root.path()).unwrap(), sample());
        let text = std::fs::read_to_string(root.path().join(CONFIG_FILE)).unwrap();
        assert!(text.contains("background = \"#ff0010\""), "{text}");
        // A run's file describes the run: it is a file for --config, too.
        let again = Partial::read(&root.path().join(CONFIG_FILE)).unwrap();
        assert_eq!(again.describe().unwrap(), sample().spec);
    }

    #[test]
    fn a_missing_or_broken_file_is_named() {
        let root = tempfile::tempdir().unwrap();
        let message = RunConfig::read(root.path()).unwrap_err().message;
        assert!(message.contains("holds no run") && message.contains("config.toml"), "{message}");
        for (text, word) in [("densify = 3", "string"), ("densify = \"1\"\nnear = 2", "near")] {
            std::fs::write(root.path().join(CONFIG_FILE), text).unwrap();
            let message = RunConfig::read(root.path()).unwrap_err().message;
            assert!(message.contains("config.toml") && message.contains(word), "{message}");
        }
    }

    #[test]
    fn a_relative_scene_is_found_from_where_the_run_was_started() {
        let root = tempfile::tempdir().unwrap();
        std::fs::create_dir_all(root.path().join("data/room")).unwrap();
        let mut config = sample();
        assert_eq!(config.scene_path(), Path::new("data/room"));
        config.resolved.working_directory = Some(root.path().to_owned());
        assert_eq!(config.scene_path(), root.path().join("data/room"));
    }
}
