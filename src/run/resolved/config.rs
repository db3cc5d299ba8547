//! `config.toml`: a run with a value for every option, and the findings behind these values. Only this module converts
//! a resolved run to the file and back.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use toml::{Table, Value};

use super::case::Init;
use super::sources::{DegreeSource, ExposureSource, PoseSource, VignetteSource};
use super::{ResolvedRun, ResolvedTraining};
use crate::failure::Failure;
use crate::spec::{
    Assignment, Budget, ImageCache, InitChoice, NOT_OPTIONS, Partial, Rows, RunSpec, ShDegree,
    add_missing_parameters, assignments,
};
use densify_core::antialiasing::Antialiasing;
use densify_core::files::{FileError, write_atomically};
use densify_data::dataset::{DepthFinding, is_archive};
use densify_train::output::{CONFIG_FILE, FolderError};

/// A resolved run as stored in its `config.toml`.
#[derive(Debug, Clone, PartialEq)]
pub struct RunConfig {
    /// Version of densify that made the run.
    pub densify: String,
    /// A description that reproduces the run: it names every choice.
    pub spec: RunSpec,
    /// The findings behind the choices.
    pub resolved: Findings,
    /// Maximum number of rows.
    pub budget: usize,
    /// The highest spherical-harmonic degree.
    pub sh_degree: u8,
    /// Parameters of the policy that the file lacks, as they were added to the policy later. The description has them,
    /// with values that stand for what the run did.
    pub assumed: Vec<Assignment>,
}

/// Facts that preparing a run has found, and the reasons for its choices.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Findings {
    /// The folder that a relative path of the dataset starts from.
    pub working_directory: Option<PathBuf>,
    /// The GPU adapter that trained; `None`: the processor.
    pub adapter: Option<String>,
    /// The order in which a GPU added up gradients; `None`: the processor.
    pub accumulation: Option<String>,
    /// The iteration to which a resumed run was extended beyond its length. Schedules do not depend on it: learning
    /// rates keep their final values.
    pub extended_to: Option<u32>,
    /// The reason for the degree.
    pub sh_degree_from: DegreeSource,
    /// True if `--memory` made the degree lower than requested.
    pub sh_degree_lowered: bool,
    /// The reason for learning exposures or not.
    pub exposure_from: ExposureSource,
    /// True if exposures are learned.
    pub has_exposures: bool,
    /// The reason for refining poses or not.
    #[serde(skip_serializing_if = "PoseSource::is_given")]
    pub poses_from: PoseSource,
    /// True if poses are refined.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub refines_poses: bool,
    /// The reason for learning vignettes or not.
    #[serde(skip_serializing_if = "VignetteSource::is_given")]
    pub vignette_from: VignetteSource,
    /// True if vignettes are learned.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub has_vignettes: bool,
    /// The model that the run started from.
    pub init_model: Option<ModelSize>,
    /// The model whose Gaussians never change.
    pub frozen: Option<ModelSize>,
    /// The given depth that is trained on.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub depth: Option<DepthFinding>,
    /// What the policy's decisions depend on besides densify, such as the version of Python; not in the file of a policy
    /// that is a part of densify.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub policy: Option<String>,
}

/// The size of a model in a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelSize {
    /// Number of Gaussians.
    pub rows: usize,
    /// Spherical-harmonic degree.
    pub sh_degree: u8,
    /// Its antialiasing; not written for a model without antialiasing.
    #[serde(default, skip_serializing_if = "is_none")]
    pub antialiasing: Antialiasing,
}

/// True for a model without antialiasing.
fn is_none(antialiasing: &Antialiasing) -> bool {
    !antialiasing.is_on()
}

impl RunConfig {
    /// A run that ends at step `last`, with the policy and rates of `training`.
    pub(crate) fn new(
        run: &ResolvedRun<'_>,
        training: &ResolvedTraining,
        last: u32,
    ) -> Result<Self, Failure> {
        let ResolvedRun { case, size, init, degree_lowered, .. } = run;
        let (inputs, choices, asked) = (&case.inputs, &case.choices, case.spec);
        let mut spec = asked.clone();
        // The output folder is the one that holds `config.toml`.
        spec.output.output = None;
        let budget = asked.size.budget.unwrap_or(Budget::Rows(size.rows));
        spec.size.budget = Some(budget.limited_to(size.rows));
        spec.size.sh_degree = Some(match asked.size.sh_degree {
            Some(ShDegree::Auto(_)) => ShDegree::Auto(Some(size.sh_degree)),
            _ => ShDegree::Fixed(size.sh_degree),
        });
        // If the knob `pairs_per_row` is set, it determines the length of the tile lists.
        spec.size.tile_cap = choices.knobs.pairs_per_row.is_none().then_some(Rows(size.tile_cap));
        spec.size.image_cache = Some(ImageCache::Bytes(size.image_cache));
        spec.device.backend = inputs.device.kind().choice();
        spec.device.gpu = inputs.device.adapter().map(str::to_owned);
        spec.start.init = Some(match init {
            Init::Points => InitChoice::Points,
            Init::Random(points) => {
                spec.start.init_points = Some(Rows(*points));
                InitChoice::Random
            }
            Init::Model(file) => InitChoice::Model(file.clone()),
        });
        spec.start.freeze.clone_from(&inputs.frozen_file);
        // Without antialiasing, the option is written only if it was given.
        if choices.antialiasing.is_on() {
            spec.start.antialias = Some(choices.antialiasing);
        }
        spec.start.near = Some(choices.near.fraction);
        let rates = Table::try_from(training.rates).map_err(Failure::input)?;
        spec.schedule.lr = assignments(&in_shortest_decimals(rates));
        spec.schedule.knob = assignments(&choices.knobs.table());
        // Parameters of other policies stay, as one file may serve several policies.
        let name = choices.entry.name;
        spec.density.policy_set.retain(|set| set.path.first().is_none_or(|policy| policy != name));
        spec.density.policy_set.extend(assignments(&training.parameters).into_iter().map(|set| {
            let path = std::iter::once(name.to_owned()).chain(set.path).collect();
            Assignment { path, value: set.value }
        }));
        let is_relative = asked.start.scene.as_ref().is_some_and(|scene| scene.is_relative());
        let resolved = Findings {
            // A name that is not UTF-8 cannot be in the file.
            working_directory: std::env::current_dir()
                .ok()
                .filter(|folder| is_relative && folder.to_str().is_some()),
            adapter: inputs.device.adapter().map(str::to_owned),
            accumulation: inputs.device.accumulation().map(|order| order.name().to_owned()),
            extended_to: (last > asked.schedule.iterations.0).then_some(last),
            sh_degree_from: choices.degree.source,
            sh_degree_lowered: *degree_lowered,
            exposure_from: choices.exposure.source,
            has_exposures: choices.exposure.is_on,
            poses_from: choices.poses.source,
            refines_poses: choices.poses.is_on,
            vignette_from: choices.vignette.source,
            has_vignettes: choices.vignette.is_on,
            init_model: inputs.init_model,
            frozen: inputs.frozen_model,
            depth: inputs.dataset.depth.clone(),
            policy: choices.entry.provenance(),
        };
        Ok(Self {
            densify: env!("CARGO_PKG_VERSION").to_owned(),
            spec,
            resolved,
            budget: size.rows,
            sh_degree: size.sh_degree,
            assumed: Vec::new(),
        })
    }

    /// The content of `config.toml`.
    pub fn table(&self) -> Result<Table, Failure> {
        let mut table = self.spec.table()?;
        table.insert("densify".into(), self.densify.clone().into());
        let resolved = Table::try_from(&self.resolved).map_err(Failure::input)?;
        table.insert("resolved".into(), resolved.into());
        Ok(table)
    }

    /// Reads a table that [`table`](Self::table) returned.
    ///
    /// # Errors
    /// Names the key, and what was expected.
    pub fn from_table(mut table: Table, origin: &str) -> Result<Self, Failure> {
        let fail = |problem: &str| Failure::input(problem).within(origin);
        let [densify, resolved] = NOT_OPTIONS.map(|key| table.remove(key));
        let Some(Value::String(densify)) = densify else {
            return Err(fail("`densify` must be a string, the version that wrote the file"));
        };
        let resolved = resolved.unwrap_or_else(|| Table::new().into());
        let resolved = Findings::deserialize(resolved)
            .map_err(|error| fail(&format!("resolved: {}", error.to_string().trim())))?;
        let assumed = add_missing_parameters(&mut table);
        let spec = Partial::recorded(table, origin)?.spec()?;
        match (spec.size.budget.and_then(Budget::most), spec.size.sh_degree) {
            (Some(budget), Some(ShDegree::Fixed(sh_degree) | ShDegree::Auto(Some(sh_degree)))) => {
                Ok(Self { densify, spec, resolved, budget, sh_degree, assumed })
            }
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
    /// When there is none, or it is malformed.
    pub fn read(run: &Path) -> Result<Self, Failure> {
        let path = run.join(CONFIG_FILE);
        let text = densify_core::files::read_text(&path, densify_core::files::MAX_OPTIONS_BYTES)
            .map_err(|error| match error.kind() {
                _ if is_archive(run) => Failure::input(format!(
                    "{} is a ZIP archive, but not a SOG model; unpack it, and name a file of Gaussian splats, or the \
                     folder of a run, in it",
                    run.display()
                )),
                std::io::ErrorKind::NotFound | std::io::ErrorKind::NotADirectory => {
                    FolderError::no_run(run, CONFIG_FILE).into()
                }
                _ => Failure::input(format!("cannot read {}: {error}", path.display())),
            })?;
        let malformed = |problem: String| Failure::from(FileError::malformed(&path, problem));
        let table: Table = text
            .parse()
            .map_err(|error: toml::de::Error| malformed(error.to_string().trim().into()))?;
        Self::from_table(table, &path.display().to_string())
    }

    /// The step at which the run ends.
    pub fn last(&self) -> u32 {
        self.resolved.extended_to.unwrap_or(0).max(self.spec.schedule.iterations.0)
    }

    /// The dataset's path: in the folder from which the run was started, if it exists there, or else as given.
    pub fn scene_path(&self) -> PathBuf {
        let given = self.spec.start.scene.clone().unwrap_or_default();
        let from_start = self.resolved.working_directory.as_ref().map(|folder| folder.join(&given));
        from_start.filter(|path| path.exists()).unwrap_or(given)
    }
}

/// Gives `f32` values their shortest decimals: 0.005 rather than 0.004999999888241291.
fn in_shortest_decimals(mut table: Table) -> Table {
    for value in table.iter_mut().map(|(_, value)| value) {
        if let Value::Float(number) = value
            && f64::from(*number as f32).total_cmp(number).is_eq()
        {
            *number = (*number as f32).to_string().parse().unwrap_or(*number);
        }
    }
    table
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::spec::{ByteCount, PolicyFile};
    use densify_data::track_colours::Spread;
    use densify_train::schedule::Background;

    #[test]
    fn a_file_is_not_a_run() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let message = RunConfig::read(file.path()).unwrap_err().to_string();
        assert!(message.contains("is neither a model nor a run; name a file"), "{message}");
        // An empty ZIP archive has only the record that ends archives.
        let empty = [&b"PK\x05\x06"[..], &[0; 18]].concat();
        std::fs::write(file.path(), empty).unwrap();
        let message = RunConfig::read(file.path()).unwrap_err().to_string();
        assert!(message.contains("is a ZIP archive, but not a SOG model; unpack"), "{message}");
    }

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
        spec.density.policy_set =
            ["diet.pixel_loss=l1", "diet.rho=0.2"].map(|set| set.parse().unwrap()).to_vec();
        let spread = Spread {
            tracks: 4_000,
            on_surface: 0.75,
            median: 0.5,
            tenth: 1.5,
            twentieth: 2.5,
            rms: 6.0,
        };
        let resolved =
            Findings { sh_degree_from: DegreeSource::Spread(spread), ..Findings::default() };
        let (densify, assumed) = ("0.1.0".into(), Vec::new());
        RunConfig { densify, spec, resolved, budget: 28_000, sh_degree: 3, assumed }
    }

    #[test]
    fn configs_are_read_back_unchanged() {
        let root = tempfile::tempdir().unwrap();
        sample().write(root.path()).unwrap();
        assert_eq!(RunConfig::read(root.path()).unwrap(), sample());
        let text = std::fs::read_to_string(root.path().join(CONFIG_FILE)).unwrap();
        assert!(text.contains("background = \"#ff0010\""), "{text}");
        // The file can also be passed to --config.
        let again = Partial::read(&root.path().join(CONFIG_FILE)).unwrap();
        assert_eq!(again.describe().unwrap(), sample().spec);
    }

    #[test]
    fn a_run_of_before_a_parameter_keeps_what_it_did() {
        let root = tempfile::tempdir().unwrap();
        let (mut config, expected) = (sample(), sample());
        let added = config.spec.density.policy_set.remove(0);
        config.write(root.path()).unwrap();
        let read = RunConfig::read(root.path()).unwrap();
        assert_eq!((read.spec, read.assumed), (expected.spec.clone(), vec![added]));
        let again = Partial::read(&root.path().join(CONFIG_FILE)).unwrap();
        assert_eq!(again.describe().unwrap(), expected.spec);
        // A file that is not a run's leaves defaults to the policy.
        let by_hand = root.path().join("by-hand.toml");
        std::fs::write(&by_hand, "policy = 'diet'\npolicy_set.diet.rho = 0.2").unwrap();
        let by_hand = Partial::read(&by_hand).unwrap().describe().unwrap();
        assert_eq!(by_hand.density.policy_set.len(), 1);
    }

    #[test]
    fn a_run_is_read_without_its_policies() {
        let root = tempfile::tempdir().unwrap();
        let mut config = sample();
        config.spec.density.policy_file = vec![PolicyFile("moved/away.py".into())];
        config.spec.density.policy = "unknown".into();
        config.spec.density.policy_set.push("unknown.rho=0.2".parse().unwrap());
        config.write(root.path()).unwrap();
        let read = RunConfig::read(root.path()).unwrap();
        assert_eq!(read, config);
        Partial::all(&read.spec).unwrap();
        // A policy is needed to train, and in options that are given now.
        read.spec.policy().unwrap_err();
        Partial::read(&root.path().join(CONFIG_FILE)).unwrap_err();
    }

    #[test]
    fn a_missing_or_broken_file_is_named() {
        let root = tempfile::tempdir().unwrap();
        let message = RunConfig::read(root.path()).unwrap_err().to_string();
        assert!(message.contains("holds no run") && message.contains("config.toml"), "{message}");
        for (text, word) in [("densify = 3", "string"), ("densify = \"1\"\nnear = 2", "near")] {
            std::fs::write(root.path().join(CONFIG_FILE), text).unwrap();
            let message = RunConfig::read(root.path()).unwrap_err().to_string();
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
