//! What is asked of a plan.

use std::path::PathBuf;
use std::str::FromStr;

use densify_run::Partial;

/// Most strips, and cells of a strip.
pub(super) const MOST: usize = 1000;

/// How many blocks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Grid {
    /// As few as fit the memory of a task.
    Auto,
    /// Strips along the longer side of the ground, and blocks in each.
    Of([usize; 2]),
}

impl FromStr for Grid {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let number = |text: &str| text.parse().ok().filter(|n| (1..=MOST).contains(n));
        let parts = match text.split_once(['x', 'X', '×']) {
            Some((strips, across)) => number(strips).zip(number(across)),
            None if text == "auto" => return Ok(Self::Auto),
            None => number(text).map(|strips| (strips, 1)),
        };
        let (strips, across) = parts.ok_or_else(|| {
            format!("`{text}` is no division into blocks; give 4, 3x2 or auto, at most {MOST} along a side")
        })?;
        Ok(Self::Of([strips, across]))
    }
}

/// How large the merged model may be.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Size {
    /// So many Gaussians.
    Rows(usize),
    /// So many bytes of its PLY.
    Bytes(u64),
}

/// What is planned.
#[derive(Debug, Clone)]
pub struct PlanOptions {
    /// The dataset.
    pub scene: PathBuf,
    /// Folder to write the plan to, which does not exist yet or is empty.
    pub output: PathBuf,
    /// Size of the merged model.
    pub size: Size,
    /// Most memory of a task `[bytes]`.
    pub memory: Option<u64>,
    /// How many blocks.
    pub grid: Grid,
    /// Budget of the coarse run; `None`: two fifths of the whole, or what leaves a block as many rows of its own in
    /// `memory`.
    pub coarse_rows: Option<usize>,
    /// How far beyond its cell a block trains, as a share of a cell's usual width.
    pub margin: f64,
    /// Options of `densify train` for every run; iterations are those of one run over the whole scene.
    pub given: Partial,
}
