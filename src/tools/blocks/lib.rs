//! Trains a large scene in blocks and merges their models. A plan describes the runs and their memory.
//!
//! The ground is divided into cells of equal work (`cells.rs`). A coarse run trains the whole scene. Each block is then
//! a run of its own: it trains on the views that see its cell or its margin (`visibility.rs`), starts from the coarse
//! Gaussians in and around the cell, and renders the other visible Gaussians as frozen (`task.rs`). Its Gaussians
//! within the cell become its part of the merged model (`merge.rs`). Every block has a share of the budget, so the
//! merged model stays within the budget. `densify_launch` starts the tasks. Prints nothing.

mod cells;
mod ground;
mod merge;
mod options;
mod plan;
mod plan_svg;
mod status;
mod submit;
mod task;
mod visibility;

use std::path::{Path, PathBuf};

use glam::DVec3;
use serde::{Deserialize, Serialize};

pub use cells::Cell;
use densify_core::files;
use densify_core::files::FileError;
use densify_core::gaussians::Gaussians;
use densify_run::failure::Failure;
pub use ground::Ground;
pub use merge::{Merged, merge};
pub use options::{Grid, PlanOptions, Size};
pub use plan::plan;
pub use status::{TaskState, status};
pub use submit::submit;
pub use task::run;

/// Largest accepted plan `[bytes]`; a block takes 0.3 kB.
const MAX_PLAN_BYTES: u64 = 256 << 20;
/// File name of the plan.
pub const PLAN_FILE: &str = "plan.toml";
/// Names of the files with the options of the coarse run and of a block's run, both the user's and the plan's own.
const COARSE_FILE: &str = "coarse.toml";
const BLOCK_FILE: &str = "block.toml";
/// Default file name of the merged model.
const MERGED_FILE: &str = "merged.ply";

/// A plan, as stored in its file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BlockPlan {
    /// Version of densify that made the plan.
    pub densify: String,
    /// Absolute path of the dataset.
    pub scene: PathBuf,
    /// Budget of the merged model.
    pub rows: usize,
    /// Spherical-harmonic degree.
    pub sh_degree: u8,
    /// Processor threads of a task.
    pub threads: u32,
    /// Margin around a cell in which its block trains too, along both axes of the ground `[world units]`.
    pub margin: [f64; 2],
    /// Upper bound of a merge's memory `[bytes]`.
    pub merge_memory: u64,
    /// The ground plane.
    pub ground: Ground,
    /// The run over the whole scene.
    pub coarse: Coarse,
    /// The blocks.
    pub block: Vec<Block>,
}

/// The run over the whole scene from whose model the blocks start.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Coarse {
    /// Maximum number of Gaussians.
    pub rows: usize,
    /// Number of iterations.
    pub iterations: u32,
    /// Upper bound of its memory `[bytes]`.
    pub memory: u64,
}

/// A block.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Block {
    /// Name of the block and of its folder.
    pub name: String,
    /// Its share of the merged model's budget.
    pub rows: usize,
    /// Budget in training, margin included and frozen rows excluded; the merge drops the Gaussians in the margin.
    pub budget: usize,
    /// Number of training views that see its cell or margin.
    pub views: usize,
    /// Number of iterations.
    pub iterations: u32,
    /// Upper bound of its memory `[bytes]`.
    pub memory: u64,
    /// Fraction of the total work.
    pub work: f64,
    /// The part of the ground that it covers.
    pub cell: Cell,
}

/// A task of a plan.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Task {
    /// The run over the whole scene.
    Coarse,
    /// The run of the block with this index.
    Block(usize),
    /// The merge of all blocks.
    Merge,
}

impl BlockPlan {
    /// Reads the plan of a folder.
    ///
    /// # Errors
    /// If the file is missing or malformed.
    pub fn read(folder: &Path) -> Result<Self, Failure> {
        let path = folder.join(PLAN_FILE);
        let text = files::read_text(&path, MAX_PLAN_BYTES).map_err(|error| {
            let remedy = "name a folder that `densify blocks plan` wrote";
            Failure::input(format!("{}: {error}; {remedy}", path.display()))
        })?;
        let malformed =
            |problem: String| Failure::from(FileError::malformed(&path, problem.trim()));
        let plan: Self = toml::from_str(&text).map_err(|error| malformed(error.to_string()))?;
        match plan.block.iter().find(|block| !is_plain(&block.name)) {
            Some(block) => Err(malformed(format!("`{}` is not a valid block name", block.name))),
            None if plan.block.is_empty() => Err(malformed("it has no block".to_owned())),
            None => Ok(plan),
        }
    }

    /// All tasks, each after those it depends on.
    pub fn tasks(&self) -> impl Iterator<Item = Task> {
        let blocks = (0..self.block.len()).map(Task::Block);
        std::iter::once(Task::Coarse).chain(blocks).chain([Task::Merge])
    }

    /// Finds a task by name.
    ///
    /// # Errors
    /// If there is no such task.
    pub fn task(&self, name: &str) -> Result<Task, Failure> {
        self.tasks().find(|task| self.name(*task) == name).ok_or_else(|| {
            let names: Vec<&str> = self.tasks().map(|task| self.name(task)).collect();
            let count = names.len();
            let tasks = if count <= 12 { names.join(", ") } else { format!("{count} tasks") };
            Failure::input(format!("this plan has no task `{name}`; it has {tasks}"))
        })
    }

    /// The name of a task.
    pub fn name(&self, task: Task) -> &str {
        match task {
            Task::Coarse => "coarse",
            Task::Block(index) => &self.block[index].name,
            Task::Merge => "merge",
        }
    }

    /// Upper bound of a task's memory `[bytes]`.
    pub fn memory(&self, task: Task) -> u64 {
        match task {
            Task::Coarse => self.coarse.memory,
            Task::Block(index) => self.block[index].memory,
            Task::Merge => self.merge_memory,
        }
    }

    /// Number of iterations of a task; 0 for the merge.
    pub fn iterations(&self, task: Task) -> u32 {
        match task {
            Task::Coarse => self.coarse.iterations,
            Task::Block(index) => self.block[index].iterations,
            Task::Merge => 0,
        }
    }

    /// True if the centre of a Gaussian lies in a cell.
    fn is_in_cell(&self, cell: &Cell, centre: DVec3) -> bool {
        cell.contains(self.ground.project(centre))
    }

    /// The rows of a model whose centres lie in a cell.
    fn rows_in_cell(&self, cell: &Cell, model: &Gaussians) -> Vec<usize> {
        let is_inside = |row: &usize| self.is_in_cell(cell, DVec3::from(model.position(*row)));
        (0..model.len()).filter(is_inside).collect()
    }
}

/// True if a name from a file cannot lead out of the plan's folder.
fn is_plain(name: &str) -> bool {
    let is_word = |c: char| c.is_ascii_alphanumeric() || c == '-';
    !name.is_empty() && name.chars().all(is_word)
}

/// Folder of a block.
fn block_folder(folder: &Path, name: &str) -> PathBuf {
    folder.join("blocks").join(name)
}

/// Folder of the run of a task.
///
/// # Panics
/// For the merge, which is not a run.
fn run_folder(folder: &Path, plan: &BlockPlan, task: Task) -> PathBuf {
    match task {
        Task::Coarse => folder.join("coarse"),
        Task::Block(index) => block_folder(folder, &plan.block[index].name).join("run"),
        Task::Merge => unreachable!("a merge is not a run"),
    }
}

#[cfg(test)]
mod tests;
