//! What every layer of `densify` knows: cameras, Gaussians, images, colours, the memory ledger, and files that are
//! written whole. Nothing here knows a file format of models or datasets, a device, or a thread.

pub mod budget;
pub mod camera;
pub mod camera_path;
pub mod colour;
pub mod curve;
pub mod files;
pub mod gaussians;
pub mod image;
pub mod memory;
pub mod numbers;
pub mod pieces;
pub mod resample;
pub mod sh;
pub mod spelling;
pub mod spline;
