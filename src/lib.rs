//! `densify` trains 3D Gaussian Splatting scenes under a hard memory budget.
pub mod backend;
pub mod camera;
pub mod cli;
pub mod dataset;
pub mod evaluate;
pub mod gaussians;
pub mod init;
pub mod memory;
pub mod metrics;
pub mod output;
pub mod ply;
pub mod schedule;
pub mod sh;
pub mod trainer;
pub mod views;
