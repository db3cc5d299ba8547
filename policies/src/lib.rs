//! Density-control policies for 3D Gaussian Splatting.
pub mod plan;
pub mod policy;
pub mod rng;
