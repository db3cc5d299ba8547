//! Plans blocks: divides the ground, determines each block's views and share of the budget, and estimates the memory of
//! each task from its ledger.

use std::fs;
use std::path::{Path, PathBuf};

use tempfile::TempDir;

use super::cells::divide;
use super::options::{Grid, MAX_GRID, PlanOptions, Size};
use super::task::VIEWS_FILE;
use super::visibility::Visibility;
use super::{
    BLOCK_FILE, Block, BlockPlan, COARSE_FILE, Cell, Coarse, Ground, PLAN_FILE, block_folder,
    plan_svg,
};
use densify_core::camera::Camera;
use densify_core::files::{FileError, folder_of, write_atomically};
use densify_core::gaussians::{MAX_SH_DEGREE, sh_coefficients};
use densify_core::memory::Bytes;
use densify_core::numbers::grouped;
use densify_data::dataset::{Dataset, TrackReading, builtin, view_line};
use densify_data::models::Coordinates;
use densify_run::failure::Failure;
use densify_run::{
    AbsolutePath, Budget, Host, InitChoice, ModelSize, Observer, Partial, RunSpec, ShDegree,
    estimate, say_notes,
};
use densify_train::exposure::ExposureChoice;
use densify_train::poses::PoseChoice;
use densify_train::vignette::VignetteChoice;

/// Minimum number of Gaussians of a block.
const MIN_ROWS: usize = 100;
/// Default budget of the coarse run, as a fraction of the merged model's. Blocks compensate errors of their frozen
/// neighbours, so a better coarse model gives a better merged one (docs/blocks.md).
const COARSE_SHARE: [usize; 2] = [2, 5];
/// Smallest default budget of the coarse run.
const MIN_COARSE_ROWS: usize = 1_000;
/// The coarse run has the iterations of a single run over the whole scene, divided by this number.
const COARSE_SHORTENING: u32 = 2;
/// Maximum width of the images of the coarse run `[px]`.
const COARSE_WIDTH: u32 = 400;
/// Options of a run that the plan sets itself.
const OWN_OPTIONS: [&str; 10] = [
    "scene",
    "output",
    "budget",
    "memory",
    "init",
    "init_points",
    "freeze",
    "views",
    "save_iterations",
    "view",
];

/// Plans blocks and writes the plan's folder, completely or not at all.
///
/// # Errors
/// If the dataset cannot be read or divided, a task does not fit, or the folder is not empty.
pub fn plan(options: &PlanOptions, observer: &dyn Observer) -> Result<BlockPlan, Failure> {
    let planner = Planner::new(options, observer)?;
    let staging = create_staging(&options.output)?;
    let blocks = match options.grid {
        Grid::Fixed(grid) => planner.plan_grid(grid, staging.path())?,
        Grid::Auto => planner.plan_fewest(staging.path())?,
    };
    planner.write(&blocks, staging.path())?;
    let target = &options.output;
    fs::rename(staging.path(), target)
        .map_err(FileError::io("move the plan to the folder", target))?;
    Ok(blocks)
}

/// Creates a temporary folder beside the plan's folder.
fn create_staging(output: &Path) -> Result<TempDir, Failure> {
    let is_empty = fs::read_dir(output).map(|mut entries| entries.next().is_none());
    match is_empty {
        Ok(true) => {}
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => {}
        _ => {
            return Err(Failure::input(format!(
                "{} exists and is not empty; choose another folder with -o",
                output.display()
            )));
        }
    }
    let parent = folder_of(output);
    let made = fs::create_dir_all(parent)
        .and_then(|()| tempfile::Builder::new().prefix(".densify-").tempdir_in(parent));
    Ok(made.map_err(FileError::io("write to the folder", parent))?)
}

struct Planner<'a> {
    options: &'a PlanOptions,
    scene: PathBuf,
    spec: RunSpec,
    dataset: Dataset,
    ground: Ground,
    visibility: Visibility,
    rows: usize,
    sh_degree: u8,
    coarse_rows: usize,
}

impl<'a> Planner<'a> {
    fn new(options: &'a PlanOptions, observer: &dyn Observer) -> Result<Self, Failure> {
        if let Some((name, _)) = options.given.iter().find(|(name, _)| OWN_OPTIONS.contains(name)) {
            return Err(Failure::input(format!(
                "--{} is set by the plan itself; leave it out after `--`",
                name.replace('_', "-")
            )));
        }
        let spec = options.given.clone().describe()?;
        if spec.size.sh_degree == Some(ShDegree::Auto(None)) {
            return Err(Failure::input(
                "--sh-degree auto: blocks must have one degree; give 0, 1, 2 or 3",
            ));
        }
        if spec.schedule.poses != PoseChoice::Fixed {
            return Err(Failure::input(format!(
                "--poses {}: each block would move its cameras by itself, and the blocks of a model must agree; train \
                 one model with refined poses, or leave the option out",
                spec.schedule.poses.name()
            )));
        }
        if spec.schedule.exposure == ExposureChoice::Auto {
            return Err(Failure::input(
                "--exposure auto: each block would decide for itself, and the blocks of a model must agree; give on \
                 or off",
            ));
        }
        if spec.schedule.vignette == VignetteChoice::Auto {
            return Err(Failure::input(
                "--vignette auto: each block would decide for itself, and the blocks of a model must agree; give on \
                 or off",
            ));
        }
        if spec.output.coordinates == Coordinates::Double {
            return Err(Failure::input(
                "--coordinates double: a merged model has world or local coordinates; give local, or leave it out",
            ));
        }
        let sh_degree = match spec.size.sh_degree {
            Some(ShDegree::Fixed(degree)) => degree,
            _ => MAX_SH_DEGREE,
        };
        let scene = match builtin::name(&options.scene) {
            Some(_) => options.scene.clone(),
            None => std::path::absolute(&options.scene).map_err(Failure::input)?,
        };
        let dataset = Dataset::load(&scene, &spec.data.load_options(TrackReading::Views))?;
        say_notes(observer, &dataset.notes);
        let normalisation = &dataset.normalisation;
        let cameras: Vec<Camera> = dataset
            .train
            .iter()
            .map(|v| normalisation.world_from_scene_camera(&v.camera))
            .collect();
        let ground = Ground::fit(&cameras);
        let visibility = Visibility::new(&dataset, &ground)?;
        let rows = match options.size {
            Size::Rows(rows) => rows,
            Size::Bytes(bytes) => {
                let row = (size_of::<f32>() * (14 + 3 * sh_coefficients(sh_degree))) as u64;
                // 4,096 bytes are more than the header takes.
                usize::try_from(bytes.saturating_sub(4096) / row).unwrap_or(usize::MAX)
            }
        };
        if rows < MIN_ROWS {
            return Err(Failure::input(format!(
                "{rows} Gaussians are too few for a merged model; give --rows or --bytes for at \
                 least {MIN_ROWS}"
            )));
        }
        let mut planner = Self {
            options,
            scene,
            spec,
            dataset,
            ground,
            visibility,
            rows,
            sh_degree,
            coarse_rows: 0,
        };
        planner.coarse_rows =
            options.coarse_rows.map_or_else(|| planner.default_coarse_rows(), Ok)?;
        Ok(planner)
    }

    /// Default budget of the coarse run.
    fn default_coarse_rows(&self) -> Result<usize, Failure> {
        let [part, whole] = COARSE_SHARE;
        let mut rows = self.rows * part / whole;
        if self.options.memory.is_some() {
            let spec = self.spec_of(self.shared_options(), self.rows)?;
            // Half of what fits: a block holds frozen Gaussians besides its own.
            rows = rows.min(estimate(&spec, [None, None], Host::default())?.0 / 2);
        }
        Ok(rows.max(MIN_COARSE_ROWS))
    }

    /// Plans the fewest blocks whose tasks fit in memory.
    fn plan_fewest(&self, staging: &Path) -> Result<BlockPlan, Failure> {
        let Some(memory) = self.options.memory else {
            return Err(Failure::input(
                "--blocks auto needs --memory, to find the fewest blocks that fit it; give \
                 --memory, or the number of blocks",
            ));
        };
        let mut last = None;
        for side in 1..=MAX_GRID {
            for grid in [[side, side.saturating_sub(1).max(1)], [side, side]] {
                match self.plan_grid(grid, staging) {
                    Ok(blocks) => return Ok(blocks),
                    // Smaller blocks may fit, until they are too small to train.
                    Err(failure) if is_too_large(&failure) => last = Some(failure),
                    Err(failure) => {
                        return Err(last.unwrap_or(failure).and(&format!(
                            "no division fits --memory {}: {}x{} blocks are already too small; give more memory, \
                             or fewer --rows",
                            Bytes(memory),
                            grid[0],
                            grid[1]
                        )));
                    }
                }
            }
        }
        Err(Failure::input(format!("--memory {}: no division fits", Bytes(memory))))
    }

    /// Plans a given number of blocks.
    fn plan_grid(&self, grid: [usize; 2], staging: &Path) -> Result<BlockPlan, Failure> {
        let point_work = self.visibility.work();
        let total: f64 = point_work.iter().sum();
        let widths = self.visibility.widths();
        let margin = [0, 1].map(|axis| self.options.margin * widths[axis] / grid[axis] as f64);
        let points = &self.visibility.on_ground;
        let mut blocks = Vec::new();
        for (index, cell) in divide(points, &point_work, grid).into_iter().enumerate() {
            let name = format!("block-{}-{}", index / grid[1], index % grid[1]);
            let share = |cell: &Cell| {
                let inside = points.iter().zip(&point_work).filter(|(at, _)| cell.contains(**at));
                inside.map(|(_, work)| work).sum::<f64>() / total.max(f64::MIN_POSITIVE)
            };
            let rows_for = |share: f64| (self.rows as f64 * share) as usize;
            let widened = cell.widened(margin);
            // The margin has the same density of Gaussians per unit of work.
            let (budget, work) = (rows_for(share(&widened)), share(&cell));
            let rows = rows_for(work);
            let views = self.visibility.views(&self.dataset, &self.ground, &widened);
            let train = views.iter().filter(|(_, part)| part.is_some()).count();
            if train == 0 || rows < MIN_ROWS {
                return Err(Failure::input(format!(
                    "{name} of {}x{} would have {train} training views and {rows} Gaussians, which \
                     is not enough; give fewer --blocks, or more --rows",
                    grid[0], grid[1]
                )));
            }
            let folder = block_folder(staging, &name);
            let lines: String = views.iter().map(|(name, part)| view_line(name, *part)).collect();
            write_atomically(&folder.join(VIEWS_FILE), |out| out.write_all(lines.as_bytes()))?;
            let share_of_views = train as f64 / self.dataset.train.len() as f64;
            let whole = f64::from(self.spec.schedule.iterations.0);
            let iterations = ((whole * share_of_views).round() as u32).max(1);
            let memory = self.memory_of_block(&name, budget, iterations, &folder)?;
            let views = train;
            blocks.push(Block { name, rows, budget, views, iterations, memory, work, cell });
        }
        let coarse = self.coarse()?;
        let largest = blocks.iter().map(|block| block.budget).max().unwrap_or(0) + self.coarse_rows;
        Ok(BlockPlan {
            densify: env!("CARGO_PKG_VERSION").to_owned(),
            scene: self.scene.clone(),
            rows: self.rows,
            sh_degree: self.sh_degree,
            threads: self.threads(),
            margin,
            merge_memory: super::merge::memory(largest, self.sh_degree),
            ground: self.ground,
            coarse,
            block: blocks,
        })
    }

    fn threads(&self) -> u32 {
        let own = self.spec.device.threads.map(|threads| threads.0);
        let cores = || rayon::current_num_threads().try_into().unwrap_or(1);
        own.unwrap_or_else(cores)
    }

    /// The options that all tasks share.
    fn shared_options(&self) -> Partial {
        let mut options = Partial::option("sh_degree", i64::from(self.sh_degree))
            .over(Partial::option("threads", i64::from(self.threads())));
        if let Some(bytes) = self.options.memory {
            let bytes = i64::try_from(bytes).unwrap_or(i64::MAX);
            options = Partial::option("memory", bytes).over(options);
        }
        options.over(self.options.given.clone())
    }

    fn block_options(&self, iterations: u32) -> Partial {
        Partial::option("iterations", i64::from(iterations)).over(self.shared_options())
    }

    fn coarse_options(&self) -> Partial {
        let iterations = (self.spec.schedule.iterations.0 / COARSE_SHORTENING).max(1);
        let mut options = Partial::option("iterations", i64::from(iterations));
        let width = self.dataset.largest_image().0;
        if self.spec.data.resolution.is_none() && width > COARSE_WIDTH {
            options = Partial::option("resolution", i64::from(COARSE_WIDTH)).over(options);
        }
        options.over(self.shared_options())
    }

    /// Describes a run with these options on the plan's scene.
    fn spec_of(&self, options: Partial, budget: usize) -> Result<RunSpec, Failure> {
        let mut spec = options.describe()?;
        spec.start.scene = Some(self.scene.clone());
        spec.size.budget = Some(Budget::Rows(budget));
        Ok(spec)
    }

    /// Upper bound of the memory of a block's run, which holds at most the whole coarse model besides its own rows.
    fn memory_of_block(
        &self,
        name: &str,
        rows: usize,
        iterations: u32,
        folder: &Path,
    ) -> Result<u64, Failure> {
        let mut spec = self.spec_of(self.block_options(iterations), rows + self.coarse_rows)?;
        spec.data.views = Some(AbsolutePath(folder.join(VIEWS_FILE)));
        spec.start.init = Some(InitChoice::Model(AbsolutePath(folder.to_owned())));
        let coarse = Some(ModelSize {
            rows: self.coarse_rows,
            sh_degree: self.sh_degree,
            antialiasing: spec.start.antialias.unwrap_or_default(),
        });
        self.memory_of_run(name, &spec, [coarse, coarse])
    }

    fn coarse(&self) -> Result<Coarse, Failure> {
        let spec = self.spec_of(self.coarse_options(), self.coarse_rows)?;
        let memory = self.memory_of_run("the coarse run", &spec, [None, None])?;
        Ok(Coarse { rows: self.coarse_rows, iterations: spec.schedule.iterations.0, memory })
    }

    /// Upper bound of a run's memory; fails if it exceeds the limit. `models` are the sizes of the models of `--init`
    /// and `--freeze`.
    fn memory_of_run(
        &self,
        name: &str,
        spec: &RunSpec,
        models: [Option<ModelSize>; 2],
    ) -> Result<u64, Failure> {
        let wanted = spec.size.budget.and_then(Budget::most).unwrap_or_default();
        let (rows, ledger) = estimate(spec, models, Host::default())?;
        if rows < wanted {
            let memory = Bytes(self.options.memory.unwrap_or_default());
            return Err(Failure::input(format!(
                "{TOO_LARGE} for --memory {memory}: {name} has {} Gaussians, but only {} fit; give more --blocks, \
                 more --memory, or fewer --rows",
                grouped(wanted),
                grouped(rows)
            )));
        }
        Ok(ledger.on_host())
    }

    /// Writes all files except the lists of views, which already exist.
    fn write(&self, plan: &BlockPlan, staging: &Path) -> Result<(), Failure> {
        let text =
            |partial: Partial| toml::to_string(&partial.into_table()).map_err(Failure::input);
        let put = |path: PathBuf, text: String| {
            write_atomically(&path, |out| out.write_all(text.as_bytes()))
        };
        // Divisions that did not fit have left folders of other blocks.
        let names: Vec<&str> = plan.block.iter().map(|block| &*block.name).collect();
        for entry in fs::read_dir(staging.join("blocks")).into_iter().flatten().flatten() {
            if !names.iter().any(|name| entry.file_name() == *name) {
                let path = entry.path();
                fs::remove_dir_all(&path).map_err(FileError::io("remove", &path))?;
            }
        }
        put(staging.join(COARSE_FILE), text(self.coarse_options())?)?;
        for block in &plan.block {
            let path = block_folder(staging, &block.name).join(BLOCK_FILE);
            put(path, text(self.block_options(block.iterations))?)?;
        }
        let drawing = plan_svg::draw(plan, &self.visibility.on_ground, &self.dataset);
        put(staging.join("plan.svg"), drawing)?;
        put(staging.join(PLAN_FILE), toml::to_string(plan).map_err(Failure::input)?)?;
        Ok(())
    }
}

/// Start of the message of a failure that a plan with more blocks may avoid.
const TOO_LARGE: &str = "a task is too large";

fn is_too_large(failure: &Failure) -> bool {
    failure.to_string().starts_with(TOO_LARGE)
}
