//! The message of every [`Problem`], with options in the user's spelling. The messages share one file so that they can
//! be compared.

use std::path::Path;

use densify_core::memory::Bytes;
use densify_core::numbers::grouped;
use densify_core::spelling::Spelling;
use densify_data::{DepthRemedy, LoadError, LoadRemedy};
use densify_render::Accumulation;

use super::notes::antialias_option;
use super::problem::{
    BackendRemedy, Difference, ModelProblem, OptionProblem, Problem, Remedy, ResumeProblem,
    SizeProblem, TrainRemedy, TrainingProblem,
};

/// The remedy for a model in other coordinates.
const TRANSFORM_BACK: &str = "export it untransformed, or transform it back";

impl Problem {
    /// The message: what is wrong, and the remedy.
    pub fn words(&self, spelling: Spelling) -> String {
        match self {
            Self::Options(problem) => problem.words(spelling),
            Self::Size(problem) => problem.words(spelling),
            Self::Model(problem) => problem.words(spelling),
            Self::Resume(problem) => problem.words(spelling),
            Self::Training(problem) => problem.words(spelling),
            Self::Backend(remedy) => remedy.words(spelling),
            Self::Train(remedy) => remedy.words(spelling),
            Self::Load(error) => load_error(error, spelling),
        }
    }
}

pub(super) fn load_error(error: &LoadError, s: Spelling) -> String {
    match error {
        LoadError::Data(problem) => problem.clone(),
        LoadError::Remedied { problem, remedy } => {
            format!("{problem}; {}", load_remedy(*remedy, s))
        }
        LoadError::ViewList { file, problem } => {
            format!("{}: {problem}", s.text("views", file.display()))
        }
        LoadError::NoMasks { listing, inverted } => {
            let option = if *inverted {
                s.switch("invert_masks")
            } else {
                s.text("mask_mode", "background")
            };
            let kind = match s {
                Spelling::Terminal => "flag",
                Spelling::Keyword => "argument",
            };
            format!(
                "{}: {option}: no photograph has a mask; put masks into `masks/`, named after their photographs as \
                 NAME.png, or leave the {kind} out",
                listing.display()
            )
        }
    }
}

fn depth_remedy(remedy: DepthRemedy, s: Spelling) -> String {
    let words = match remedy {
        DepthRemedy::AddFiles => "add the files".to_owned(),
        DepthRemedy::Repair => "export the depth again".to_owned(),
        DepthRemedy::Unit => format!("state the unit with {}", s.option("depth_unit")),
        DepthRemedy::AlongRay => format!("say so with {}", s.text("depth_along", "ray")),
        DepthRemedy::AlongAxis => format!("leave {} out", s.text("depth_along", "ray")),
        DepthRemedy::Relative => format!("fit them with {}", s.text("depth_unit", "relative")),
        DepthRemedy::NotRelative => format!("state their unit with {}", s.option("depth_unit")),
        DepthRemedy::Register => "register depth and photographs first".to_owned(),
        DepthRemedy::OtherViews => {
            "check that each map has the name of its photograph, and that none is turned".to_owned()
        }
        DepthRemedy::Align => "move the cloud to the coordinates of the dataset".to_owned(),
        DepthRemedy::Params => "write depth_params.json again for this model".to_owned(),
        DepthRemedy::MorePoints => "reconstruct the scene with more points".to_owned(),
        DepthRemedy::LeaveOut => {
            return format!("or train without depth with {}", s.text("depth", "off"));
        }
    };
    format!("{words}, or train without depth with {}", s.text("depth", "off"))
}

fn load_remedy(remedy: LoadRemedy, s: Spelling) -> String {
    let (words, option) = match remedy {
        LoadRemedy::RestoreOrImagesFolder => {
            ("restore it, or name the folder that holds the images with {}", s.option("images"))
        }
        LoadRemedy::AddOrImagesFolder => {
            ("put the images there, or name their folder with {}", s.option("images"))
        }
        LoadRemedy::OtherImagesFolder => (
            "only paths below the dataset's folder are followed (another folder of images can be given with {})",
            s.option("images"),
        ),
        LoadRemedy::ImagesFolderOfBoth => (
            "use {} to name a folder that contains both files at their original paths, or remove one of the two",
            s.option("images"),
        ),
        LoadRemedy::InvertMasks(true) => ("give {}, or remove the masks", s.switch("invert_masks")),
        LoadRemedy::InvertMasks(false) => {
            ("leave {} out, or remove the masks", s.switch("invert_masks"))
        }
        LoadRemedy::LargerTestEvery => ("use a larger {}, or leave it out", s.option("test_every")),
        LoadRemedy::KeepFieldOfView => (
            "train on that field alone with {}, or calibrate again with fewer terms, or undistort the images first, \
             e.g. with `colmap image_undistorter`",
            s.switch("keep_fov"),
        ),
        LoadRemedy::ColmapModel => (
            "use {} to name a folder that holds cameras and images, as .bin or .txt",
            s.option("sparse"),
        ),
        LoadRemedy::Depth(remedy) => return depth_remedy(remedy, s),
    };
    words.replace("{}", &option)
}

impl BackendRemedy {
    fn words(self, s: Spelling) -> String {
        let [budget, sh_degree, tile_cap, threads, resolution, gpu] =
            ["budget", "sh_degree", "tile_cap", "threads", "resolution", "gpu"]
                .map(|name| s.option(name));
        let native = s.text("backend", "cpu");
        match self {
            Self::LessMemory => format!("lower {budget}, {sh_degree} or {tile_cap}"),
            Self::FewerThreads => format!("lower {threads}"),
            Self::SmallerImages => format!("shrink the images with {resolution}"),
            Self::ListAdapters => {
                format!("`densify devices` lists the adapters, and {native} needs none")
            }
            Self::NoAdapterOrGpu => format!("leave out {gpu} or {native}"),
            Self::BuildWithGpu => format!(
                "add it to the features of densify in Cargo.toml, or leave out {} and {gpu}",
                s.text("backend", "gpu")
            ),
            Self::Budget(rows) => format!("use {}", s.set("budget", rows)),
            Self::TileCap(pairs) => format!("use {}", s.set("tile_cap", pairs)),
            Self::NativeBackend => format!("use {native}"),
            Self::StartAgain => format!("start again from what was saved, or use {native}"),
            Self::SlotsOrOtherDriver => format!(
                "{} may avoid this; otherwise try another driver, or {native}",
                s.member("knob", "accumulation", Accumulation::Slots)
            ),
            Self::OtherDriver => format!("try another driver, or {native}"),
        }
    }
}

impl TrainRemedy {
    fn words(self, s: Spelling) -> String {
        let (folder, overwrite) = (output_option(s), s.switch("overwrite"));
        match self {
            Self::OtherFolderOrOverwrite => {
                let resume = s.switch("resume");
                format!(
                    "continue it with {resume}, choose another folder with {folder}, or replace it with {overwrite}"
                )
            }
            Self::WaitOrOtherFolder => {
                format!("wait for it, stop it, or choose another folder with {folder}")
            }
            Self::OtherFolder => format!("choose another one with {folder}"),
            Self::Budget => format!("give {} at least 1", s.option("budget")),
            Self::Degree => format!("choose {} accordingly", s.option("sh_degree")),
            Self::RandomStart => {
                format!("start from random points with {}", s.text("init", "random"))
            }
            Self::MoreViews => format!("use a larger {} or add images", s.option("test_every")),
        }
    }
}

impl OptionProblem {
    fn words(&self, s: Spelling) -> String {
        let [budget, freeze, knob] = ["budget", "freeze", "knob"].map(|name| s.option(name));
        let full = s.switch("full");
        match self {
            Self::UnknownOption { name, nearest } => {
                let hint = nearest.as_ref().map(|like| format!(" (did you mean `{like}`?)"));
                let hint = hint.unwrap_or_default();
                format!("no option is called `{name}`{hint}; docs/options.md lists them all")
            }
            Self::Value { option, problem } => format!("{}: {problem}", s.option(option)),
            Self::Conflict { option, problem } => format!("{} {problem}", s.option(option)),
            Self::PolicySetting { setting } => format!(
                "{}: `{setting}` is not of the form policy.parameter=value, such as diet.rho=0.2",
                s.option("policy_set")
            ),
            Self::NotUtf8 { option, path } => format!(
                "{}: the name {path:?} is not UTF-8, as config.toml must be; rename the folder, or name a link to it",
                s.option(option)
            ),
            Self::NoScene => "no scene is given; name a dataset's folder, or a built-in scene such as scene:spheres \
                              (in a file: scene = \"...\")"
                .to_owned(),
            Self::IterationOutOfRange { option, step, last } => {
                format!("{} is out of range: the run has iterations 1 to {last}", s.set(option, step))
            }
            Self::Malformed { origin, problem } => format!("{origin}: {problem}"),
            Self::AccumulationConflict { given } => format!(
                "{}, which takes accumulation={}, and {} contradict each other; give one of them",
                s.switch("deterministic"),
                Accumulation::Slots,
                s.member("knob", "accumulation", given)
            ),
            Self::KnobOfOtherBackend { knob: name, value, backend, only_on, default } => format!(
                "{knob}: knob {name}={value}: the {} backend does not have this knob; leave it at {name}={default}, \
                 or use {}",
                backend.name(),
                s.text("backend", only_on.choice().word())
            ),
            Self::AutomaticWithFull { option } => {
                let auto = s.text(option, "auto");
                let other = match *option {
                    "budget" => "a number of Gaussians".to_owned(),
                    option => s.set(option, 3),
                };
                format!(
                    "{full} disables automatic reductions, and {auto} is one; give one of the two, or {full} with {other}"
                )
            }
            Self::AutoBudgetWithFreeze => format!(
                "{} removes Gaussians with little effect, but {freeze} keeps some regardless; give {budget} a \
                 number of Gaussians",
                s.text("budget", "auto")
            ),
            Self::PosesWithFreeze { choice } => format!(
                "{}: the Gaussians of {freeze} cannot follow moving poses; refine the poses in the run that makes them, \
                 or leave one of the two out",
                s.text("poses", choice.name())
            ),
            Self::FocalWithoutPoses => format!(
                "{}: focal lengths are adjusted together with poses; add {}",
                s.switch("refine_focal"),
                s.text("poses", "refine")
            ),
            Self::UnusedInitPoints { points } => format!(
                "{}: it is for a random start; leave it out, or use {}",
                s.set("init_points", points),
                s.text("init", "random")
            ),
            Self::VignetteOfDivided { view } => format!(
                "{}: photographs are divided into several views, such as {view}, whose radii differ from the \
                 photograph's; use {}, or photographs of a narrower lens",
                s.text("vignette", "on"),
                s.text("vignette", "off")
            ),
            Self::NothingToTest => format!(
                "{}: no view is held out to measure; add {} or {}",
                s.option("test_iterations"),
                s.switch("eval"),
                s.set("test_every", "K")
            ),
        }
    }
}

impl SizeProblem {
    fn words(&self, s: Spelling) -> String {
        let memory = |bytes: &u64| s.text("memory", Bytes(*bytes));
        let [budget, freeze, tile_cap, image_cache, threads] =
            ["budget", "freeze", "tile_cap", "image_cache", "threads"].map(|name| s.option(name));
        match self {
            Self::TooManyViews => "the scene has more than 4 billion views".to_owned(),
            Self::FreezeFillsBudget { frozen, budget: rows } => format!(
                "{freeze}: its {} Gaussians leave no room in a budget of {}, which counts them too; give a larger \
                 {budget}, or freeze fewer",
                grouped(*frozen),
                grouped(*rows)
            ),
            Self::TileCapConflict { cap, pairs } => format!(
                "{cap} and {} contradict each other; give one of them, such as {cap} with pairs_per_row=auto",
                s.member("knob", "pairs_per_row", pairs),
                cap = s.set("tile_cap", cap)
            ),
            Self::OverMemory { memory: given, needed, remedies } => {
                let remedy = match &remedies[..] {
                    [] => format!("leave out {tile_cap}, {image_cache} and {threads}"),
                    remedies => format!("give {}", any_of(remedies, s)),
                };
                format!("{}: this run takes {}; {remedy}", memory(given), Bytes(*needed))
            }
            Self::OverGrant { needed, resident, limit, left, remedies } => {
                let remedy = match &remedies[..] {
                    [] => "free memory, or raise that limit".to_owned(),
                    remedies => format!("give {}, or free memory", any_of(remedies, s)),
                };
                let [needed, resident, left] = [*needed, *resident, *left].map(Bytes);
                format!(
                    "this run takes {needed} of the host's memory, of which the process already has {resident}; \
                     {limit} leaves the process {left} more; {remedy}"
                )
            }
            Self::NoSize { memory: given } => {
                format!("{}: no size fits, and no sufficient limit is known", memory(given))
            }
            Self::NoModelFits { memory: given, rows, sh_degree, needed, remedies } => format!(
                "{} holds no model of this scene: {} rows at degree {sh_degree} take {needed} MiB; give {}",
                memory(given),
                grouped(*rows),
                any_of(remedies, s)
            ),
        }
    }
}

impl ModelProblem {
    fn words(&self, s: Spelling) -> String {
        let file = |option: &str, file: &Path| s.text(option, file.display());
        let iterations = |numbers: &str| s.set("save_iterations", numbers);
        match self {
            Self::EmptyModel { option, file: model } => format!(
                "{}: the model has no Gaussian; give another one, or leave {} out",
                file(option, model),
                s.option(option)
            ),
            Self::InitOutOfView { file: model, seen, rows } => format!(
                "{}: only {} of its {} Gaussians lie in any training view; it must be in the coordinates of the \
                 dataset: {TRANSFORM_BACK}",
                file("init", model),
                grouped(*seen),
                grouped(*rows)
            ),
            Self::FreezeOutOfView { file: model, rows } => format!(
                "{}: none of its {} Gaussians lies in any training view; it must be in the coordinates of the dataset: \
                 {TRANSFORM_BACK}",
                file("freeze", model),
                grouped(*rows)
            ),
            Self::AntialiasingDiffers { init, frozen } => format!(
                "the antialiasing of the model of {} is {init}, that of {} is {frozen}, but both are rendered together; \
                 choose one with {}",
                s.option("init"),
                s.option("freeze"),
                antialias_option(s, *init)
            ),
            Self::FreezeChanged { file: model, rows, expected } => format!(
                "{}: it has {} Gaussians, but had {} before; begin a new run",
                file("freeze", model),
                grouped(*rows),
                grouped(*expected)
            ),
            Self::OtherCoordinates { option, file: model, correlation } => {
                let model = model_name(s, *option, model);
                format!(
                    "{model}: it shows nothing of the photographs (their correlation is {correlation:.2}); it must be \
                     in the coordinates of the dataset (axes, scale and origin): {TRANSFORM_BACK}"
                )
            }
            Self::NoTestViews => format!(
                "no view was held out (a run holds views out with {} or {}); use {}",
                s.switch("eval"),
                s.set("test_every", "K"),
                s.text("split", "train")
            ),
            Self::DatasetMoved => {
                // Training takes the scene as a positional argument, other commands with this flag.
                let scene = flag_or_keyword(s, "scene", "--scene");
                format!("if the dataset has moved, say where it is with {scene}")
            }
            Self::NoModelYet { run, step } => {
                let (run, earlier) = (run.display(), iterations("N"));
                format!(
                    "{run} holds a run that was stopped before it saved a model, with a checkpoint of iteration \
                     {step}; `densify train --resume -o {run}` continues from there, and saves its model at the end, \
                     or earlier with {earlier}"
                )
            }
            Self::NoSuchIteration { iteration, run, saved } => {
                let saved: Vec<String> = saved.iter().map(u32::to_string).collect();
                let (iteration, run) = (s.set("iteration", iteration), run.display());
                format!("{iteration}: {run} has saved only {}", saved.join(", "))
            }
            Self::StillTraining { run } => format!(
                "{} is being trained and has saved no model yet; wait until one is saved, or train with {} to look at \
                 models before the end of the run",
                run.display(),
                iterations("1000,2000")
            ),
            Self::IterationOfFile => {
                format!(
                    "{} is for a run's folder; a file has only one model",
                    s.option("iteration")
                )
            }
        }
    }
}

impl ResumeProblem {
    fn words(&self, s: Spelling) -> String {
        let [resume, overwrite] = ["resume", "overwrite"].map(|name| s.switch(name));
        let folder = output_option(s);
        match self {
            Self::InterruptedReplacement { output, staged } => format!(
                "{resume}: {} holds an interrupted run, in {}, that was to replace the run there; resume the \
                 interrupted run by naming its folder with {folder}, or remove that folder",
                output.display(),
                staged.display()
            ),
            Self::Shortened { asked, origin, length, done } => format!(
                "{} contradicts {origin}: that run has {length} iterations, of which {done} are done; it can be \
                 extended, not shortened",
                s.set("iterations", asked)
            ),
            Self::AutoOnResume { option, origin, saved } => format!(
                "{resume}: {} contradicts {origin}, which was given {saved}; leave it out, or begin a new run without \
                 {resume}",
                s.text(option, "auto")
            ),
            Self::NoSoundCheckpoint { output, errors } => {
                let errors: String = errors.iter().map(|error| format!("\n  {error}")).collect();
                format!(
                    "{resume}: no checkpoint in {} can be used:{errors}\nto start over, leave {resume} out and give \
                     {overwrite}",
                    output.display()
                )
            }
            Self::NoCheckpoint { output } => format!(
                "{resume}: {} holds a run, but no checkpoint to resume from; to start over, leave {resume} out and \
                 give {overwrite}, or choose another folder with {folder}",
                output.display()
            ),
            Self::Continued { output } => format!(
                "another program has continued or removed the run in {} since this one was saved there; {resume} \
                 continues that run, and {folder} names another folder",
                output.display()
            ),
            Self::ResultWouldDiffer { origin, differences } => {
                let shown = |value: &Option<String>| value.clone().unwrap_or("not set".to_owned());
                let line = |difference: &Difference| {
                    let Difference { option, member, now, then } = difference;
                    let option = format!("{} {member}", s.option(option));
                    let (now, then) = (shown(now), shown(then));
                    format!("\n  {}: {now} now, {then} in that run", option.trim())
                };
                format!(
                    "{resume}: this call contradicts {}:{}\nleave these options out, or begin a new run without \
                     {resume}",
                    origin.display(),
                    differences.iter().map(line).collect::<String>()
                )
            }
            Self::OtherDataset { origin, difference } => format!(
                "{resume}: this is not the dataset of {}: {difference}; give the dataset of that run, or begin a new \
                 run without {resume}",
                origin.display()
            ),
        }
    }
}

impl TrainingProblem {
    fn words(&self, s: Spelling) -> String {
        match self {
            Self::DrawsNothing { empty, views } => format!(
                "the model draws nothing in {empty} of the last {views} views; check the poses of the cameras, and \
                 that they and the points use the same coordinate system, or lower {}",
                s.option("near")
            ),
            Self::Stopped { by, step: None } => format!("stopped by {by}; nothing was written"),
            Self::Stopped { by, step: Some(step) } => format!("stopped by {by} after step {step}"),
            Self::CheckpointFailed { error } => format!("no checkpoint could be written: {error}"),
            Self::ModelSaved { saved: Ok(file) } => {
                format!("the model as it was before is saved in {}", file.display())
            }
            Self::ModelSaved { saved: Err(error) } => {
                format!("the model could not be saved: {error}")
            }
            Self::OnlyMeasuringFailed { run } => {
                format!("the run itself is complete in {}", run.display())
            }
            Self::LeftBehind { run, checkpoint: None, .. } => {
                format!("the files written so far are in {}", run.display())
            }
            Self::LeftBehind { run, checkpoint: Some(checkpoint), scene } => {
                let (run, scene) = (run.display(), scene.display());
                let command = match s {
                    Spelling::Terminal => format!("densify train {scene} -o {run} --resume"),
                    Spelling::Keyword => {
                        format!("densify.train({}, {})", s.text("output", &run), s.switch("resume"))
                    }
                };
                let checkpoint = checkpoint.display();
                format!(
                    "the files written so far are in {run}, with the checkpoint {checkpoint}; continue with: {command}"
                )
            }
        }
    }
}

/// Lists alternatives as `A`, `A, or B`, `A, or B, or C`; each may consist of several changes.
fn any_of(remedies: &[Vec<Remedy>], s: Spelling) -> String {
    let all = remedies.iter().map(|changes| {
        let changes: Vec<String> = changes.iter().map(|change| change.words(s)).collect();
        changes.join(" ")
    });
    all.collect::<Vec<_>>().join(", or ")
}

impl Remedy {
    fn words(self, s: Spelling) -> String {
        match self {
            Self::NoImages => s.set("image_cache", 0),
            Self::NoTileCap => format!("no {}", s.option("tile_cap")),
            Self::TileCap(pairs) => s.set("tile_cap", pairs),
            Self::Preset(name) => s.text("preset", name),
            Self::LeastDegree => s.set("sh_degree", 0),
            Self::Shrink(divisor) => match s {
                Spelling::Terminal => format!("-r {divisor}"),
                Spelling::Keyword => s.set("resolution", divisor),
            },
            Self::Memory(mib) => s.text("memory", format_args!("{mib}MiB")),
            Self::Budget(rows) => s.set("budget", rows),
        }
    }
}

/// A model's file, with the option that names it if there is one.
pub(super) fn model_name(s: Spelling, option: Option<&str>, file: &Path) -> String {
    let file = file.display();
    option.map_or_else(|| file.to_string(), |option| s.text(option, &file))
}

/// The output folder, in its short form on a terminal.
fn output_option(s: Spelling) -> String {
    flag_or_keyword(s, "output", "-o")
}

/// An option whose flag on a terminal is `flag` instead of its usual one.
fn flag_or_keyword(s: Spelling, name: &str, flag: &str) -> String {
    match s {
        Spelling::Terminal => flag.to_owned(),
        Spelling::Keyword => s.option(name),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::failure::{Failure, INPUT};

    #[test]
    fn errors_of_datasets_name_options() {
        let (listing, remedy) = ("a.txt".into(), LoadRemedy::InvertMasks(false));
        let remedied = LoadError::Remedied { problem: "none left".to_owned(), remedy };
        let no_masks = LoadError::NoMasks { listing, inverted: false };
        let views = LoadError::ViewList { file: "v.txt".into(), problem: "line 2".to_owned() };
        let words = [remedied, no_masks, views].map(|error| Failure::from(error).to_string());
        assert_eq!(words[0], "none left; leave --invert-masks out, or remove the masks");
        assert_eq!(
            words[1],
            "a.txt: --mask-mode background: no photograph has a mask; put masks into `masks/`, named after their \
             photographs as NAME.png, or leave the flag out"
        );
        assert_eq!(words[2], "--views v.txt: line 2");
    }

    #[test]
    fn options_are_spelled_as_users_write_them() {
        let remedies = vec![vec![Remedy::NoImages, Remedy::Shrink(4)], vec![Remedy::Memory(96)]];
        let (memory, rows, sh_degree, needed) = (64 << 20, 1_000, 0, 96);
        let problem = SizeProblem::NoModelFits { memory, rows, sh_degree, needed, remedies };
        let failure = Failure::from(problem).within_option("config", Some("a.toml".to_owned()));
        assert_eq!(failure.code, INPUT);
        assert_eq!(
            failure.to_string(),
            "--config a.toml: --memory 64.0 MiB holds no model of this scene: 1,000 rows at degree 0 take 96 MiB; \
             give --image-cache 0 -r 4, or --memory 96MiB"
        );
        assert_eq!(
            failure.words(Spelling::Keyword),
            "config=\"a.toml\": memory=\"64.0 MiB\" holds no model of this scene: 1,000 rows at degree 0 take 96 \
             MiB; give image_cache=0 resolution=4, or memory=\"96MiB\""
        );
        let problem = OptionProblem::AutomaticWithFull { option: "sh_degree" };
        let words = Failure::from(problem).words(Spelling::Keyword);
        assert!(words.ends_with("or full=True with sh_degree=3"), "{words}");
    }
}
