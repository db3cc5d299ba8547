//! The basic types that every layer of `densify` uses: cameras, Gaussians, images, colours, the memory ledger, and
//! safe file access. Formats of models and datasets, devices and threads belong to the layers above.

pub mod antialiasing;
pub mod budget;
pub mod camera;
pub mod camera_path;
pub mod colour;
pub mod curve;
pub mod files;
pub mod gaussians;
pub mod image;
pub mod linear;
pub mod memory;
pub mod numbers;
pub mod pieces;
pub mod pose;
pub mod sh;
pub mod similarity;
pub mod spelling;
pub mod spline;
pub mod vignette;
