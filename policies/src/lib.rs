//! Density-control policies for 3D Gaussian Splatting.
mod edit;
mod ops;
pub mod plan;
pub mod policy;
pub mod rng;
pub mod sample;
