//! `densify` trains 3D Gaussian Splatting scenes under a hard memory budget.
pub mod backend;
pub mod camera;
pub mod dataset;
pub mod gaussians;
pub mod init;
pub mod memory;
pub mod ply;
