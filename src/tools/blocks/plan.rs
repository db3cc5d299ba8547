//! Makes a plan: cuts the ground, finds each block's views and share, and asks the ledger what each task takes.

use std::fs;
use std::path::{Path, PathBuf};

use tempfile::TempDir;

use super::divide::cells;
use super::options::{Grid, MOST, PlanOptions, Size};
use super::picture::picture;
use super::sight::Sight;
use super::{
    BLOCK_FILE, Block, Blocks, COARSE_FILE, Cell, Coarse, Ground, PLAN_FILE, block_folder,
};
use densify_core::camera::Camera;
use densify_core::files::{FileError, write_atomically};
use densify_core::gaussians::{MAX_SH_DEGREE, sh_coefficients};
use densify_core::memory::Bytes;
use densify_core::numbers::grouped;
use densify_data::dataset::{Dataset, builtin, view_line};
use densify_run::failure::Failure;
use densify_run::{
    AbsolutePath, Budget, Host, InitChoice, ModelSize, Observer, Partial, RunSpec, ShDegree,
    estimate, say_notes,
};
use densify_train::exposure::ExposureChoice;

/// A block with fewer Gaussians is none.
const LEAST_ROWS: usize = 100;
/// The coarse run: its share of the rows, at least so many; its share of the iterations; width of its images `[px]`.
/// Blocks take up what their frozen neighbours show wrongly, so that these must be good; docs/blocks.md has the cost.
const COARSE_ROWS: [usize; 2] = [2, 5];
const COARSE_LEAST: usize = 1_000;
const COARSE_ITERATIONS: u32 = 2;
const COARSE_WIDTH: u32 = 400;
/// Options of a run that the plan itself decides.
const OWN: [&str; 10] = [
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

/// Plans, and writes the plan's folder as a whole or not at all.
///
/// # Errors
/// When the dataset cannot be read or divided, something does not fit, or the folder is taken.
pub fn plan(options: &PlanOptions, observer: &dyn Observer) -> Result<Blocks, Failure> {
    let planner = Planner::new(options, observer)?;
    let staged = stage(&options.output)?;
    let blocks = match options.grid {
        Grid::Of(grid) => planner.divided(grid, staged.path())?,
        Grid::Auto => planner.fewest(staged.path())?,
    };
    planner.write(&blocks, staged.path())?;
    let target = &options.output;
    fs::rename(staged.path(), target)
        .map_err(FileError::io("move the plan to the folder", target))?;
    Ok(blocks)
}

/// A folder beside the plan's, which goes away with this value unless it is moved there.
fn stage(output: &Path) -> Result<TempDir, Failure> {
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
    let parent = match output.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    };
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
    sight: Sight,
    rows: usize,
    sh_degree: u8,
    coarse_rows: usize,
}

impl<'a> Planner<'a> {
    fn new(options: &'a PlanOptions, observer: &dyn Observer) -> Result<Self, Failure> {
        if let Some((name, _)) = options.given.iter().find(|(name, _)| OWN.contains(name)) {
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
        if spec.schedule.exposure == ExposureChoice::Auto {
            return Err(Failure::input(
                "--exposure auto: each block would decide for itself, and the blocks of a model must agree; give on \
                 or off",
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
        let dataset = Dataset::load(&scene, &spec.data.load_options(true))?;
        say_notes(observer, &dataset.notes);
        let to_world = &dataset.normalisation;
        let cameras: Vec<Camera> =
            dataset.train.iter().map(|v| to_world.world_from_scene_camera(&v.camera)).collect();
        let ground = Ground::of(&cameras);
        let sight = Sight::of(&dataset, &ground)?;
        let rows = match options.size {
            Size::Rows(rows) => rows,
            Size::Bytes(bytes) => {
                let row = (size_of::<f32>() * (14 + 3 * sh_coefficients(sh_degree))) as u64;
                // What comes before the rows takes less than this.
                usize::try_from(bytes.saturating_sub(4096) / row).unwrap_or(usize::MAX)
            }
        };
        if rows < LEAST_ROWS {
            return Err(Failure::input(format!(
                "a merged model of {rows} Gaussians is none; give --rows or --bytes for at least {LEAST_ROWS}"
            )));
        }
        let planner =
            Self { options, scene, spec, dataset, ground, sight, rows, sh_degree, coarse_rows: 0 };
        let coarse_rows = match options.coarse_rows {
            Some(rows) => rows,
            None => planner.usual_coarse_rows()?,
        };
        Ok(Self { coarse_rows, ..planner })
    }

    /// Rows of the coarse run where none are given.
    fn usual_coarse_rows(&self) -> Result<usize, Failure> {
        let [part, whole] = COARSE_ROWS;
        let usual = self.rows * part / whole;
        let most = match self.options.memory {
            Some(_) => {
                let mut spec = self.shared().describe()?;
                spec.start.scene = Some(self.scene.clone());
                spec.size.budget = Some(Budget::Rows(self.rows));
                // Half of what fits: a block has frozen rows and its own.
                estimate(&spec, [None, None], Host::default())?.0 / 2
            }
            None => usual,
        };
        Ok(usual.min(most).max(COARSE_LEAST))
    }

    /// The fewest blocks that fit the memory of a task.
    fn fewest(&self, staged: &Path) -> Result<Blocks, Failure> {
        let Some(memory) = self.options.memory else {
            return Err(Failure::input(
                "--blocks auto: as few as fit --memory, which is missing; give it, or the number of blocks",
            ));
        };
        let mut last = None;
        for side in 1..=MOST {
            for grid in [[side, side.saturating_sub(1).max(1)], [side, side]] {
                match self.divided(grid, staged) {
                    Ok(blocks) => return Ok(blocks),
                    // Smaller blocks may fit, as long as they are blocks.
                    Err(failure) if is_too_large(&failure) => last = Some(failure),
                    Err(failure) => {
                        let why = last.unwrap_or(failure);
                        return Err(why.and(&format!(
                            "no division fits --memory {}: {}x{} blocks are too small already; give more memory, \
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

    /// The plan with so many blocks.
    fn divided(&self, grid: [usize; 2], staged: &Path) -> Result<Blocks, Failure> {
        let work = self.sight.work();
        let total: f64 = work.iter().sum();
        let widths = self.sight.widths();
        let margin = [0, 1].map(|axis| self.options.margin * widths[axis] / grid[axis] as f64);
        let mut block = Vec::new();
        for (place, cell) in cells(&self.sight.at, &work, grid).into_iter().enumerate() {
            let name = format!("block-{}-{}", place / grid[1], place % grid[1]);
            let share = |cell: &Cell| {
                let points = self.sight.at.iter().zip(&work).filter(|(at, _)| cell.has(**at));
                points.map(|(_, work)| work).sum::<f64>() / total.max(f64::MIN_POSITIVE)
            };
            let of_all = |share: f64| (self.rows as f64 * share) as usize;
            let wide = cell.widened(margin);
            // As many per unit of work in the margin as in the cell.
            let (budget, share) = (of_all(share(&wide)), share(&cell));
            let rows = of_all(share);
            let views = self.sight.views(&self.dataset, &self.ground, &wide);
            let train = views.iter().filter(|(_, part)| part.is_some()).count();
            if train == 0 || rows < LEAST_ROWS {
                return Err(Failure::input(format!(
                    "{name} of {}x{} would have {train} training views and {rows} Gaussians, which is no model; \
                     give fewer --blocks, or more --rows",
                    grid[0], grid[1]
                )));
            }
            let folder = block_folder(staged, &name);
            let written = fs::create_dir_all(&folder);
            written.map_err(FileError::io("create the folder", &folder))?;
            let lines: String = views.iter().map(|(name, part)| view_line(name, *part)).collect();
            write_atomically(&folder.join(super::task::VIEWS_FILE), |out| {
                out.write_all(lines.as_bytes())
            })?;
            let share_of_views = train as f64 / self.dataset.train.len() as f64;
            let whole = f64::from(self.spec.schedule.iterations.0);
            let iterations = ((whole * share_of_views).round() as u32).max(1);
            let memory = self.memory_of_block(&name, budget, iterations, &folder)?;
            let views = train;
            block.push(Block { name, rows, budget, views, iterations, memory, work: share, cell });
        }
        let coarse = self.coarse()?;
        let largest = block.iter().map(|block| block.budget).max().unwrap_or(0) + self.coarse_rows;
        Ok(Blocks {
            densify: env!("CARGO_PKG_VERSION").to_owned(),
            scene: self.scene.clone(),
            rows: self.rows,
            sh_degree: self.sh_degree,
            threads: self.threads(),
            margin,
            merge_memory: super::merge::memory(largest, self.sh_degree),
            ground: self.ground,
            coarse,
            block,
        })
    }

    fn threads(&self) -> u32 {
        let own = self.spec.device.threads.map(|threads| threads.0);
        let cores = || rayon::current_num_threads().try_into().unwrap_or(1);
        own.unwrap_or_else(cores)
    }

    /// The description that all tasks share.
    fn shared(&self) -> Partial {
        let degree = Partial::option("sh_degree", i64::from(self.sh_degree));
        let threads = Partial::option("threads", i64::from(self.threads()));
        let own = degree.over(threads);
        let memory =
            |bytes: u64| Partial::option("memory", i64::try_from(bytes).unwrap_or(i64::MAX));
        let own = match self.options.memory {
            Some(bytes) => memory(bytes).over(own),
            None => own,
        };
        own.over(self.options.given.clone())
    }

    fn of_block(&self, iterations: u32) -> Partial {
        Partial::option("iterations", i64::from(iterations)).over(self.shared())
    }

    fn of_coarse(&self) -> Partial {
        let iterations = (self.spec.schedule.iterations.0 / COARSE_ITERATIONS).max(1);
        let mut own = Partial::option("iterations", i64::from(iterations));
        let width = self.dataset.largest_image().0;
        if self.spec.data.resolution.is_none() && width > COARSE_WIDTH {
            own = Partial::option("resolution", i64::from(COARSE_WIDTH)).over(own);
        }
        own.over(self.shared())
    }

    /// What the run of a block takes at most: with all of the coarse model.
    fn memory_of_block(
        &self,
        name: &str,
        rows: usize,
        iterations: u32,
        folder: &Path,
    ) -> Result<u64, Failure> {
        let mut spec = self.of_block(iterations).describe()?;
        spec.start.scene = Some(self.scene.clone());
        spec.data.views = Some(AbsolutePath(folder.join(super::task::VIEWS_FILE)));
        spec.start.init = Some(InitChoice::Model(AbsolutePath(folder.to_owned())));
        spec.size.budget = Some(Budget::Rows(rows + self.coarse_rows));
        let coarse = Some(ModelSize { rows: self.coarse_rows, sh_degree: self.sh_degree });
        self.fitting(name, &spec, [coarse, coarse])
    }

    fn coarse(&self) -> Result<Coarse, Failure> {
        let mut spec = self.of_coarse().describe()?;
        spec.start.scene = Some(self.scene.clone());
        spec.size.budget = Some(Budget::Rows(self.coarse_rows));
        let memory = self.fitting("the coarse run", &spec, [None, None])?;
        Ok(Coarse { rows: self.coarse_rows, iterations: spec.schedule.iterations.0, memory })
    }

    /// What a run takes, if it fits.
    fn fitting(
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
                "{TOO_LARGE} of --memory {memory}: {name} has {} Gaussians, of which {} fit; give more --blocks, \
                 more --memory, or fewer --rows",
                grouped(wanted),
                grouped(rows)
            )));
        }
        Ok(ledger.on_host())
    }

    /// Writes everything but the views, which are there.
    fn write(&self, blocks: &Blocks, staged: &Path) -> Result<(), Failure> {
        let text =
            |partial: Partial| toml::to_string(&partial.into_table()).map_err(Failure::input);
        let put = |path: PathBuf, text: String| {
            write_atomically(&path, |out| out.write_all(text.as_bytes()))
        };
        // Of divisions that were tried and did not fit, more may be there.
        let names: Vec<&str> = blocks.block.iter().map(|block| &*block.name).collect();
        let all = staged.join("blocks");
        for entry in fs::read_dir(&all).into_iter().flatten().flatten() {
            if !names.iter().any(|name| entry.file_name() == *name) {
                let path = entry.path();
                fs::remove_dir_all(&path).map_err(FileError::io("remove", &path))?;
            }
        }
        put(staged.join(COARSE_FILE), text(self.of_coarse())?)?;
        for block in &blocks.block {
            let path = block_folder(staged, &block.name).join(BLOCK_FILE);
            put(path, text(self.of_block(block.iterations))?)?;
        }
        put(staged.join("plan.svg"), picture(blocks, &self.sight, &self.dataset))?;
        put(staged.join(PLAN_FILE), toml::to_string(blocks).map_err(Failure::input)?)?;
        Ok(())
    }
}

/// How the failure begins that more blocks may mend.
const TOO_LARGE: &str = "a task is too large";

fn is_too_large(failure: &Failure) -> bool {
    failure.to_string().starts_with(TOO_LARGE)
}
