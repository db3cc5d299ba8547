//! Density-control policies for 3D Gaussian Splatting.
pub mod adc;
pub mod conformance;
pub mod diet;
mod edit;
#[cfg(test)]
mod event;
mod ops;
pub mod parameters;
pub mod plan;
pub mod policy;
pub mod registry;
pub mod rng;
pub mod sample;
pub mod vanilla;
