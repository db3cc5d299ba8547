//! The options of a plan.

use std::path::PathBuf;
use std::str::FromStr;

use densify_run::Partial;

/// Maximum number of strips, and of blocks per strip.
pub(super) const MAX_GRID: usize = 1000;

/// The number of blocks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Grid {
    /// The fewest blocks whose tasks fit in the memory limit.
    Auto,
    /// Number of strips along the longer side of the scene's ground, and number of blocks per strip.
    Fixed([usize; 2]),
}

impl FromStr for Grid {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let number = |text: &str| text.parse().ok().filter(|n| (1..=MAX_GRID).contains(n));
        let parts = match text.split_once(['x', 'X', '×']) {
            Some((strips, across)) => number(strips).zip(number(across)),
            None if text == "auto" => return Ok(Self::Auto),
            None => number(text).map(|strips| (strips, 1)),
        };
        let (strips, across) = parts.ok_or_else(|| {
            format!(
                "`{text}` is not a grid of blocks; give 4, 3x2 or auto, with at most {MAX_GRID} on a side"
            )
        })?;
        Ok(Self::Fixed([strips, across]))
    }
}

/// The size limit of the merged model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Size {
    /// Number of Gaussians.
    Rows(usize),
    /// Size of its PLY file `[bytes]`.
    Bytes(u64),
}

/// Options of [`plan`](super::plan()).
#[derive(Debug, Clone)]
pub struct PlanOptions {
    /// The dataset.
    pub scene: PathBuf,
    /// Folder for the plan; must be empty or not exist.
    pub output: PathBuf,
    /// Size limit of the merged model.
    pub size: Size,
    /// Memory limit of each task `[bytes]`.
    pub memory: Option<u64>,
    /// Number of blocks.
    pub grid: Grid,
    /// Budget of the coarse run. Default: two fifths of the merged model's, at most half of what fits in `memory`, and
    /// at least 1,000.
    pub coarse_rows: Option<usize>,
    /// Margin around a cell, as a fraction of the average cell width.
    pub margin: f64,
    /// Options of `densify train` for every run; `iterations` is the length of a single run over the whole scene.
    pub given: Partial,
}
