//! Values that follow from the options alone: the dataset's split, the knobs, the learning rates, the policy's
//! parameters, the output folder.

use std::path::{Path, PathBuf};

use densify_policies::policy::{PixelLoss, RateOverrides};
use densify_policies::registry::{PolicyEntry, find, import};
use toml::{Table, Value};

use super::knobs::Knobs;
use super::values;
use super::{DataSpec, DepthSpec, InitChoice, RunSpec};
use crate::failure::{Failure, OptionProblem};
use densify_data::dataset::{DepthChoice, DepthOptions, LoadOptions, Split, TrackReading, builtin};
use densify_train::schedule::{InitRates, RateOptions};
use densify_train::trainer::DepthTraining;

impl DataSpec {
    /// The options for reading the dataset.
    pub fn load_options(&self, tracks: TrackReading) -> LoadOptions {
        LoadOptions {
            images: self.images.clone(),
            sparse: self.sparse.clone(),
            resolution: self.resolution,
            split: match self.test_every {
                Some(every) => Split::Every(every),
                None if self.eval => Split::Eval,
                None => Split::None,
            },
            views: self.views.as_ref().map(|file| file.0.clone()),
            far_cameras: self.far_cameras,
            keep_fov: self.keep_fov,
            invert_masks: self.invert_masks,
            mask_mode: self.mask_mode,
            cache: builtin::cache_folder().filter(|_| !self.no_cache),
            tracks,
            depth: DepthOptions::default(),
        }
    }
}

impl DepthSpec {
    /// The use of the depth in training; `None` if it has no weight.
    pub(crate) fn training(&self) -> Option<DepthTraining> {
        let default = DepthTraining::default();
        let weight = self.depth_weight.unwrap_or(default.weight);
        let term = self.depth_term.unwrap_or(default.term);
        (!weight.is_zero()).then_some(DepthTraining { weight, term })
    }

    /// Weight of the distortion term.
    pub(crate) fn distortion(&self) -> f32 {
        self.distortion_weight.map_or(0.0, |weight| weight.0 as f32)
    }
}

impl RunSpec {
    /// The options for reading the dataset with its depth. `is_known` is the decision about depth that an earlier
    /// session of the run has taken.
    pub(crate) fn load_options(&self, tracks: TrackReading, is_known: Option<bool>) -> LoadOptions {
        let DepthSpec { depth, depth_unit, depth_along, depth_points, .. } = &self.depth;
        // A cloud that is named is meant to be used.
        let wanted = match depth.unwrap_or(DepthChoice::Auto) {
            DepthChoice::Auto if depth_points.is_some() => DepthChoice::On,
            wanted => wanted,
        };
        let choice = match is_known {
            _ if self.depth.training().is_none() => DepthChoice::Off,
            Some(true) => DepthChoice::On,
            Some(false) => DepthChoice::Off,
            None => wanted,
        };
        let depth = DepthOptions {
            choice,
            unit: *depth_unit,
            along: depth_along.unwrap_or_default(),
            points: depth_points.as_ref().map(|file| file.0.clone()),
            drops_damaged: wanted == DepthChoice::Auto,
        };
        LoadOptions { depth, ..self.data.load_options(tracks) }
    }

    /// The options as the table of a file, without those that are `None`.
    ///
    /// # Errors
    /// When a path is not UTF-8 and therefore cannot be in a TOML file.
    pub fn table(&self) -> Result<Table, Failure> {
        let Self { start, data, output, .. } = self;
        for (option, path) in [
            ("scene", &start.scene),
            ("images", &data.images),
            ("sparse", &data.sparse),
            ("output", &output.output),
        ] {
            if let Some(path) = path.as_ref().filter(|path| path.to_str().is_none()) {
                return Err(OptionProblem::NotUtf8 { option, path: path.clone() }.into());
            }
        }
        Table::try_from(self).map_err(|error| Failure::input(error.to_string().trim()))
    }

    /// The path of the dataset, or the name of a built-in scene.
    ///
    /// # Errors
    /// When none is given.
    pub fn scene(&self) -> Result<&Path, Failure> {
        let scene = self.start.scene.as_deref();
        scene.ok_or_else(|| OptionProblem::NoScene.into())
    }

    /// The folder to write to. The default is `output/SCENE-POLICY`, where SCENE is the name of the dataset's folder,
    /// or of its archive without the ending.
    ///
    /// # Errors
    /// When neither scene nor folder is given.
    pub fn output_folder(&self) -> Result<PathBuf, Failure> {
        if let Some(folder) = &self.output.output {
            return Ok(folder.clone());
        }
        let (scene, policy) = (self.scene()?, &self.density.policy);
        let name = builtin::label(scene).unwrap_or_else(|| {
            let full = scene.canonicalize().unwrap_or_else(|_| scene.to_owned());
            let last = if full.is_file() { full.file_stem() } else { full.file_name() };
            last.map_or_else(|| "scene".to_owned(), |name| name.to_string_lossy().into_owned())
        });
        Ok(Path::new("output").join(format!("{name}-{policy}")))
    }

    /// All knobs, with the values that are set and the defaults of the others.
    ///
    /// # Errors
    /// When a name is not a knob, or its value is outside the knob's domain.
    pub fn knobs(&self) -> Result<Knobs, Failure> {
        let table = values::table(&self.schedule.knob)
            .map_err(|problem| OptionProblem::Conflict { option: "knob", problem })?;
        Knobs::from_table(&table).map_err(|error| OptionProblem::value("knob", error).into())
    }

    /// The learning rates: the defaults for a run of this length and pixel term, overlaid with `policy_rates`. The rates of positions
    /// are then multiplied by `position_factor`. If the run starts from a model, the rates are
    /// [fine](RateOptions::fine), except with `--init-rates full`. `--lr` is overlaid last.
    ///
    /// # Errors
    /// When a name in `--lr` is not a rate, or its value is not allowed.
    pub(crate) fn learning_rates(
        &self,
        policy_rates: &RateOverrides,
        pixel_loss: PixelLoss,
        position_factor: f64,
    ) -> Result<RateOptions, Failure> {
        let fail = |problem: &str| Failure::from(OptionProblem::value("lr", problem.trim()));
        let iterations = self.schedule.iterations.0;
        let is_model = matches!(self.start.init, Some(InitChoice::Model(_)));
        let is_fine = is_model && self.start.init_rates == InitRates::Fine;
        // Models that are trained already keep the published rates of their end.
        let pixel_loss = if is_fine { PixelLoss::L1 } else { pixel_loss };
        let mut defaults = RateOptions::for_run(iterations, pixel_loss).with(policy_rates);
        defaults.mean_start *= position_factor;
        defaults.mean_end *= position_factor;
        defaults.noise_end = defaults.noise_end.map(|end| end * position_factor);
        if is_fine {
            defaults = defaults.fine();
        }
        let mut table = Table::try_from(defaults).map_err(|error| fail(&error.to_string()))?;
        let given = values::table(&self.schedule.lr).map_err(|error| fail(&error))?;
        for (name, rate) in given {
            let number = match rate {
                Value::Integer(number) => number as f64,
                Value::Float(number) => number,
                other => {
                    return Err(fail(&format!(
                        "{name}={other} is not of the form NAME=RATE, such as opacity=0.05"
                    )));
                }
            };
            table.insert(name, number.into());
        }
        let rates: RateOptions = table.try_into().map_err(|error| fail(&format!("{error}")))?;
        rates.problem().map_or(Ok(rates), |problem| Err(fail(&problem)))
    }

    /// Imports the policies of `--policy-file`.
    ///
    /// # Errors
    /// When this program cannot run Python, or an import fails.
    pub(crate) fn import_policies(&self) -> Result<(), Failure> {
        self.density.policy_file.iter().try_for_each(|file| {
            import(&file.0).map_err(|error| OptionProblem::value("policy_file", error).into())
        })
    }

    /// The policy, and the parameters that are set for it.
    ///
    /// # Errors
    /// When the policy does not exist, or a parameter is set to two values.
    pub fn policy(&self) -> Result<(&'static PolicyEntry, Table), Failure> {
        self.import_policies()?;
        let entry = find(&self.density.policy)?;
        let mut tables = values::table(&self.density.policy_set)
            .map_err(|problem| OptionProblem::Conflict { option: "policy_set", problem })?;
        let own = tables.remove(entry.name);
        Ok((entry, own.and_then(|own| own.as_table().cloned()).unwrap_or_default()))
    }

    /// Fails if the model is to be saved or tested after an iteration that the run does not have.
    pub(crate) fn check_iterations(&self, last: u32) -> Result<(), Failure> {
        for (option, chosen) in [
            ("save_iterations", &self.output.save_iterations),
            ("test_iterations", &self.output.test_iterations),
        ] {
            if let Some(&step) = chosen.iter().find(|&&step| step == 0 || step > last) {
                return Err(OptionProblem::IterationOutOfRange { option, step, last }.into());
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use densify_policies::policy::{Fade, Rate};

    use super::*;
    use crate::spec::{Partial, PolicyFile};

    fn spec(option: &str, value: &str) -> Result<RunSpec, Failure> {
        let file: Table = format!("{option} = {value}").parse().unwrap();
        Partial::new(file, "file.toml")?.describe()
    }

    #[test]
    fn a_named_cloud_must_be_used_unless_depth_is_off() {
        let options = |lines: &str, is_known| {
            let file: Table = lines.parse().unwrap();
            let spec = Partial::new(file, "file.toml").unwrap().describe().unwrap();
            spec.load_options(TrackReading::Nothing, is_known).depth
        };
        let cloud = "depth_points = \"/cloud.ply\"";
        for (depth, choice) in [
            ("", DepthChoice::On),
            ("depth = \"auto\"", DepthChoice::On),
            ("depth = \"off\"", DepthChoice::Off),
            ("depth_weight = 0", DepthChoice::Off),
        ] {
            let found = options(&format!("{cloud}\n{depth}"), None);
            assert_eq!(found.choice, choice, "{depth}");
            assert!(found.points.is_some(), "first points may come from it");
        }
        let found = options("", None);
        assert!(found.choice == DepthChoice::Auto && found.drops_damaged);
        let resumed = options("", Some(true));
        assert!(resumed.choice == DepthChoice::On && resumed.drops_damaged);
        assert!(!options("depth = \"on\"", None).drops_damaged);
    }

    #[test]
    fn weights_have_the_range_of_f32() {
        assert!(spec("distortion_weight", "1e38").is_ok());
        assert!(spec("distortion_weight", "1e39").is_err());
    }

    #[test]
    fn learning_rates_are_set_by_name() {
        let rates = |lr: &str, policy_rates: &RateOverrides| {
            let mut spec = spec("lr", lr).unwrap();
            spec.schedule.iterations.0 = 30_000;
            spec.learning_rates(policy_rates, PixelLoss::L1, 1.0).unwrap()
        };
        let given = rates("{ opacity = 0.05, mean_end = 1e-5 }", &RateOverrides::default());
        let expected = RateOptions { opacity: 0.05, mean_end: 1e-5, ..RateOptions::default() };
        assert_eq!(given, expected);
        let policy_rates = RateOverrides {
            mean: Some(Rate { start: 1.6e-4, end: 3e-6 }),
            opacity: Some(Rate { start: 0.5, end: 0.25 }),
            sh_rest: Some(Rate::constant(2e-4)),
            fade: Some(Fade { from: 0.5, to: 0.25 }),
            ..RateOverrides::default()
        };
        let both = rates("{ mean_end = 1e-5, opacity_end = 0.125 }", &policy_rates);
        let expected = RateOptions {
            mean_end: 1e-5,
            opacity: 0.5,
            opacity_end: Some(0.125),
            sh_rest: 2e-4,
            fade: 0.25,
            fade_from: 0.5,
            ..RateOptions::default()
        };
        assert_eq!(both, expected);
        for (bad, part) in [
            ("{ opacity = \"x\" }", "NAME=RATE"),
            ("{ colour = 1 }", "colour"),
            ("{ quat = -1 }", "quat"),
            ("{ quat_end = 0 }", "quat_end"),
            ("{ quat = inf }", "quat"),
        ] {
            let message = spec("lr", bad).unwrap_err().to_string();
            assert!(message.contains(part) && message.contains("--lr"), "{bad}: {message}");
        }
    }

    #[test]
    fn a_program_without_python_refuses_policies_in_python() {
        let message = spec("policy_file", "[\"steady.py\"]").unwrap_err().to_string();
        assert!(message.contains("--policy-file") && message.contains("pip install"), "{message}");
        let parsed = |text: &str| text.parse::<PolicyFile>().map(|file| file.0);
        assert!(parsed("steady.py").is_ok_and(|file| Path::new(&file).is_absolute()));
        assert_eq!(parsed("my.policies").as_deref(), Ok("my.policies"));
        assert!(parsed("").is_err());
    }

    #[test]
    fn the_output_is_named_after_the_scene_and_the_policy() {
        let root = tempfile::tempdir().unwrap();
        let scene = root.path().join("garden");
        std::fs::create_dir(&scene).unwrap();
        for spelling in [scene.clone(), scene.join(""), scene.join("."), scene.join("../garden")] {
            let mut spec = RunSpec::default();
            spec.start.scene = Some(spelling);
            assert_eq!(spec.output_folder().unwrap(), Path::new("output/garden-diet"));
        }
        let archive = root.path().join("garden.v2.zip");
        std::fs::write(&archive, "").unwrap();
        let mut packed = RunSpec::default();
        packed.start.scene = Some(archive);
        assert_eq!(packed.output_folder().unwrap(), Path::new("output/garden.v2-diet"));
        let mut built_in = RunSpec::default();
        built_in.start.scene = Some("scene:town:4".into());
        assert_eq!(built_in.output_folder().unwrap(), Path::new("output/town-4-diet"));
        assert!(RunSpec::default().output_folder().unwrap_err().to_string().contains("no scene"));
    }

    #[cfg(unix)]
    #[test]
    fn errors_about_folder_names_that_are_not_utf_8_name_the_option() {
        use std::os::unix::ffi::OsStringExt;
        let folder = || Some(std::ffi::OsString::from_vec(b"caf\xe9".to_vec()).into());
        let [mut scene, mut images, mut output] = [(); 3].map(|()| RunSpec::default());
        scene.start.scene = folder();
        images.data.images = folder();
        output.output.output = folder();
        for (option, spec) in [("SCENE", scene), ("--images", images), ("--output", output)] {
            let message = spec.table().unwrap_err().to_string();
            let is_named = message.starts_with(option) && message.contains("rename the folder");
            assert!(is_named, "{message}");
        }
    }
}
