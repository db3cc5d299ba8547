//! `config.toml`: everything needed to repeat a run.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::{OutputError, write_atomically};
use crate::knobs::Settings;
use crate::schedule::{Background, RateOptions};
use crate::spread::Spread;

/// Name of the file in a run's folder.
pub const CONFIG_FILE: &str = "config.toml";

/// A run as it was asked for, with all defaults filled in.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunConfig {
    /// Version of densify that made the run.
    pub densify: String,
    /// Where the images come from.
    pub scene: SceneConfig,
    /// How the model is trained.
    pub train: TrainConfig,
    /// What decides where Gaussians are born and die.
    pub policy: PolicyConfig,
    /// Knobs of the trade between speed, memory and accuracy that are no options of their own.
    #[serde(default)]
    pub knobs: Settings,
}

/// Where the images come from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SceneConfig {
    /// The dataset, as given on the command line.
    pub path: PathBuf,
    /// The folder the command line's relative paths start from.
    pub working_directory: Option<PathBuf>,
    /// Folder of the images, where not the dataset's own (`--images`).
    pub images: Option<PathBuf>,
    /// 1, 2, 4 or 8: images are so many times smaller. Other numbers: their width `[px]`.
    pub resolution: Option<u32>,
    /// Whether a test split was asked for (`--eval` or `--test-every`).
    pub eval: bool,
    /// Every so many-th image by sorted name is held out.
    pub test_every: Option<u32>,
    /// Bytes of decoded images held at a time.
    pub image_cache: u64,
    /// What lies behind the Gaussians.
    pub background: Background,
}

/// How the model is trained.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainConfig {
    /// Most rows there may ever be.
    pub budget: usize,
    /// Whether rows must pay, and the budget is what they may come to at most (`--budget auto`).
    #[serde(default)]
    pub budget_auto: bool,
    /// The memory that budget, degree, tile lists and image cache were chosen for, if they were
    /// `[bytes]`.
    #[serde(default)]
    pub memory: Option<u64>,
    /// Length of the run in steps.
    pub iterations: u32,
    /// Step to which the run was extended beyond its length. Schedules do not know of it: step sizes
    /// stay at their end.
    #[serde(default)]
    pub extended_to: Option<u32>,
    /// Seed of everything that is drawn.
    pub seed: u64,
    /// Highest spherical-harmonic degree.
    pub sh_degree: u8,
    /// Whether `--memory` has made it lower than was wanted.
    #[serde(default)]
    pub sh_degree_lowered: bool,
    /// Whether nothing is to be left out that the options do not say (`--full`).
    #[serde(default)]
    pub full: bool,
    /// Near plane as a fraction of the scene's extent.
    pub near: f64,
    /// Most (row, tile) entries held at a time; `None` lets the backend choose.
    pub tile_cap: Option<usize>,
    /// How the first Gaussians are placed.
    pub init: InitChoice,
    /// Number of points of a random initialisation.
    pub init_points: Option<usize>,
    /// Iterations per optimiser step of spherical-harmonic bands 1–3; `None`: as the policy says.
    pub sh_every: Option<u32>,
    /// The GPU adapter that trained; `None`: the processor.
    pub adapter: Option<String>,
    /// What decided the degree.
    #[serde(default)]
    pub sh_degree_from: DegreeChoice,
    /// Step sizes.
    pub learning_rates: RateOptions,
}

/// What decided the degree of a run.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DegreeChoice {
    /// The options.
    #[default]
    Given,
    /// The colours of tracks, before training.
    Spread(Spread),
    /// Nothing: tracks were asked, and there were too few on surfaces.
    Undecided,
}

/// How the first Gaussians are placed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum InitChoice {
    /// On the points of the dataset.
    Points,
    /// At random.
    Random,
}

/// A policy with its parameters.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PolicyConfig {
    /// Its name.
    pub name: String,
    /// All of its parameters as used, scaled to the run's length.
    pub parameters: toml::Table,
}

impl RunConfig {
    /// Writes `config.toml` into the run's folder.
    ///
    /// # Errors
    /// [`OutputError::Io`].
    pub fn write(&self, run: &Path) -> Result<(), OutputError> {
        let path = run.join(CONFIG_FILE);
        write_atomically(&path, |out| {
            let text = toml::to_string_pretty(self).map_err(std::io::Error::other)?;
            out.write_all(text.as_bytes())
        })
    }

    /// Reads the `config.toml` of a run.
    ///
    /// # Errors
    /// [`OutputError::NoRun`] when there is none; [`OutputError::Malformed`].
    pub fn read(run: &Path) -> Result<Self, OutputError> {
        let path = run.join(CONFIG_FILE);
        let text = match std::fs::read_to_string(&path) {
            Ok(text) => text,
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => {
                return Err(OutputError::NoRun { path: run.to_owned(), missing: CONFIG_FILE });
            }
            Err(e) => return Err(OutputError::io("read", &path)(e)),
        };
        toml::from_str(&text)
            .map_err(|e| OutputError::Malformed { path, problem: e.to_string().trim().to_owned() })
    }

    /// The dataset's folder: as given where that exists from here, else from the folder in which
    /// the run was started.
    #[must_use]
    pub fn scene_path(&self) -> PathBuf {
        let given = &self.scene.path;
        let from_there = self.scene.working_directory.as_ref().map(|folder| folder.join(given));
        match from_there {
            Some(path) if path.exists() => path,
            _ => given.clone(),
        }
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    pub(in crate::output) fn sample() -> RunConfig {
        RunConfig {
            densify: "0.1.0".into(),
            scene: SceneConfig {
                path: "data/room".into(),
                working_directory: None,
                images: Some("elsewhere".into()),
                resolution: None,
                eval: true,
                test_every: Some(8),
                image_cache: 1 << 30,
                background: Background::Colour([255, 0, 16]),
            },
            train: TrainConfig {
                budget: 28_000,
                budget_auto: true,
                memory: Some(1 << 28),
                iterations: 2_000,
                extended_to: None,
                seed: i64::MAX as u64,
                sh_degree: 3,
                sh_degree_from: DegreeChoice::Spread(Spread {
                    tracks: 4_000,
                    on_surface: 0.75,
                    median: 0.5,
                    tenth: 1.5,
                    twentieth: 2.5,
                    rms: 6.0,
                }),
                sh_degree_lowered: false,
                full: false,
                near: 0.01,
                tile_cap: None,
                init: InitChoice::Points,
                sh_every: Some(16),
                init_points: None,
                adapter: None,
                learning_rates: RateOptions::default(),
            },
            policy: PolicyConfig { name: "diet".into(), parameters: toml::toml! { rho = 0.2 } },
            knobs: Settings::of(&["alpha_min=1/128".into()]).unwrap(),
        }
    }

    #[test]
    fn what_is_written_is_read_back() {
        let root = tempfile::tempdir().unwrap();
        sample().write(root.path()).unwrap();
        assert_eq!(RunConfig::read(root.path()).unwrap(), sample());
        let text = std::fs::read_to_string(root.path().join(CONFIG_FILE)).unwrap();
        assert!(text.contains("background = \"#ff0010\""), "{text}");
    }

    #[test]
    fn a_missing_or_broken_file_is_named() {
        let root = tempfile::tempdir().unwrap();
        let message = RunConfig::read(root.path()).unwrap_err().to_string();
        assert!(message.contains("holds no run") && message.contains("config.toml"), "{message}");
        std::fs::write(root.path().join(CONFIG_FILE), "densify = 3").unwrap();
        let message = RunConfig::read(root.path()).unwrap_err().to_string();
        assert!(message.contains("config.toml") && message.contains("string"), "{message}");
    }

    #[test]
    fn a_relative_scene_is_found_from_where_the_run_was_started() {
        let root = tempfile::tempdir().unwrap();
        std::fs::create_dir_all(root.path().join("data/room")).unwrap();
        let mut config = sample();
        assert_eq!(config.scene_path(), Path::new("data/room"));
        config.scene.working_directory = Some(root.path().to_owned());
        assert_eq!(config.scene_path(), root.path().join("data/room"));
    }
}
