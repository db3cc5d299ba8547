//! A scene in blocks, for models and clusters larger than one machine: a plan of runs that know their memory, and one
//! model of what they train.
//!
//! The ground is cut into cells of equal work (`divide.rs`). A coarse run sees the whole scene. Each block then is a run
//! of its own: it has the views that see its cell (`sight.rs`), starts from the Gaussians of the coarse model in and
//! around the cell, and has the others frozen behind them (`task.rs`). What it ends with in its cell is its part of the
//! merged model (`merge.rs`), which has at most the rows that were promised, as every block has a share of them.
//! Engines start the tasks (`densify_launch`); there is no scheduler here. Prints nothing.

mod crop;
mod divide;
mod ground;
mod merge;
mod options;
mod picture;
mod plan;
mod sight;
mod status;
mod submit;
mod task;

use std::path::{Path, PathBuf};

use glam::DVec3;
use serde::{Deserialize, Serialize};

use densify_core::files;
use densify_core::files::FileError;
use densify_run::failure::Failure;
pub use divide::Cell;
pub use ground::Ground;
pub use merge::{Merged, merge};
pub use options::{Grid, PlanOptions, Size};
pub use plan::plan;
pub use status::{State, status};
pub use submit::submit;
pub use task::run;

/// Most bytes of a plan, which takes 0.4 kB per block.
const MAX_PLAN: u64 = 256 << 20;
/// The plan in its folder.
pub const PLAN_FILE: &str = "plan.toml";
/// Description of the coarse run, and of each block's, in the plan's folder: options that the user gave, and what the
/// plan decides.
const COARSE_FILE: &str = "coarse.toml";
const BLOCK_FILE: &str = "block.toml";
/// The merged model, where nothing else is said.
const MERGED_FILE: &str = "merged.ply";

/// A plan, as it stands in its file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Blocks {
    /// Version of densify that made it.
    pub densify: String,
    /// Folder of the dataset, absolute.
    pub scene: PathBuf,
    /// Most Gaussians of the merged model.
    pub rows: usize,
    /// Their spherical-harmonic degree.
    pub sh_degree: u8,
    /// Processor threads of a task.
    pub threads: u32,
    /// How far beyond its cell a block trains, along both axes of the ground `[world units]`.
    pub margin: [f64; 2],
    /// Most memory of a merge `[bytes]`.
    pub merge_memory: u64,
    /// The ground that is divided.
    pub ground: Ground,
    /// The run over the whole scene.
    pub coarse: Coarse,
    /// The blocks.
    pub block: Vec<Block>,
}

/// The run over the whole scene that blocks start from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Coarse {
    /// Its budget.
    pub rows: usize,
    /// Its length.
    pub iterations: u32,
    /// What it takes at most `[bytes]`.
    pub memory: u64,
}

/// One block.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Block {
    /// Its name, and that of its folder.
    pub name: String,
    /// Most Gaussians of it in the merged model.
    pub rows: usize,
    /// Most Gaussians that it trains, in its cell and the margin, of which the others are left out in the end.
    pub budget: usize,
    /// Training views that see it.
    pub views: usize,
    /// Length of its run.
    pub iterations: u32,
    /// What it takes at most `[bytes]`.
    pub memory: u64,
    /// Its share of the work.
    pub work: f64,
    /// Its cell.
    pub cell: Cell,
}

/// A task of a plan.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Task {
    /// The run over the whole scene.
    Coarse,
    /// The run of a block, by its place.
    Block(usize),
    /// The merge of all blocks.
    Merge,
}

impl Blocks {
    /// Reads the plan of a folder.
    ///
    /// # Errors
    /// When there is none, or it is not one.
    pub fn read(folder: &Path) -> Result<Self, Failure> {
        let path = folder.join(PLAN_FILE);
        let text = files::read_text(&path, MAX_PLAN).map_err(|error| {
            let remedy = "name a folder that `densify blocks plan` wrote";
            Failure::input(format!("{}: {error}; {remedy}", path.display()))
        })?;
        let malformed =
            |problem: String| Failure::from(FileError::malformed(&path, problem.trim()));
        let plan: Self = toml::from_str(&text).map_err(|error| malformed(error.to_string()))?;
        match plan.block.iter().find(|block| !is_plain(&block.name)) {
            Some(block) => Err(malformed(format!("`{}` is no name of a block", block.name))),
            None if plan.block.is_empty() => Err(malformed("it has no block".to_owned())),
            None => Ok(plan),
        }
    }

    /// All tasks, each after those that it needs.
    pub fn tasks(&self) -> impl Iterator<Item = Task> {
        let blocks = (0..self.block.len()).map(Task::Block);
        std::iter::once(Task::Coarse).chain(blocks).chain([Task::Merge])
    }

    /// The task of this name.
    ///
    /// # Errors
    /// When there is none.
    pub fn task(&self, name: &str) -> Result<Task, Failure> {
        self.tasks().find(|task| self.name(*task) == name).ok_or_else(|| {
            let names: Vec<&str> = self.tasks().map(|task| self.name(task)).collect();
            let count = names.len();
            let shown = if count <= 12 { names.join(", ") } else { format!("{count} of them") };
            Failure::input(format!("this plan has no task `{name}`; its tasks: {shown}"))
        })
    }

    /// The name of a task.
    #[must_use]
    pub fn name(&self, task: Task) -> &str {
        match task {
            Task::Coarse => "coarse",
            Task::Block(place) => &self.block[place].name,
            Task::Merge => "merge",
        }
    }

    /// What a task takes at most `[bytes]`.
    #[must_use]
    pub fn memory(&self, task: Task) -> u64 {
        match task {
            Task::Coarse => self.coarse.memory,
            Task::Block(place) => self.block[place].memory,
            Task::Merge => self.merge_memory,
        }
    }

    /// Length of the run of a task; 0 for the merge.
    #[must_use]
    pub fn iterations(&self, task: Task) -> u32 {
        match task {
            Task::Coarse => self.coarse.iterations,
            Task::Block(place) => self.block[place].iterations,
            Task::Merge => 0,
        }
    }

    /// Where a point of the world lies on the ground.
    fn on_ground(&self, mean: [f32; 3]) -> [f64; 2] {
        self.ground.at(DVec3::from(mean.map(f64::from)))
    }
}

/// Whether a name from a file leads nowhere else.
fn is_plain(name: &str) -> bool {
    let is_word = |c: char| c.is_ascii_alphanumeric() || c == '-';
    !name.is_empty() && name.chars().all(is_word)
}

/// Folder of a block in that of the plan.
fn block_folder(plan: &Path, name: &str) -> PathBuf {
    plan.join("blocks").join(name)
}

/// Folder of the run of a task in that of the plan.
///
/// # Panics
/// For the merge, which is no run.
fn run_folder(plan: &Path, blocks: &Blocks, task: Task) -> PathBuf {
    match task {
        Task::Coarse => plan.join("coarse"),
        Task::Block(place) => block_folder(plan, &blocks.block[place].name).join("run"),
        Task::Merge => unreachable!("a merge is no run"),
    }
}

#[cfg(test)]
mod tests;
