//! Training: the loop, what it starts from, its schedule, checkpoints, metrics, and the folder of results. Knows no
//! run and prints nothing.

pub mod checkpoint;
pub mod evaluate;
pub mod exposure;
pub mod importance;
pub mod init;
pub mod metrics;
pub mod output;
pub mod pictures;
pub mod schedule;
pub mod trainer;
