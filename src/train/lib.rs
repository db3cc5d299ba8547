//! Training: initialisation, schedules, the training loop, checkpoints, metrics, and the output folder of a run.
//! Prints nothing.

mod adam;
pub mod checkpoint;
pub mod evaluate;
pub mod exposure;
pub mod importance;
pub mod in_front;
pub mod init;
pub mod metrics;
pub mod output;
pub mod pictures;
pub mod poses;
pub mod schedule;
pub mod trainer;
pub mod vignette;
