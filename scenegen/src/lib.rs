//! Known geometry, ray-traced into posed ground-truth images.

#![allow(missing_docs)]
mod camera;
mod error;
mod intersect;
pub mod mesh;
mod nearest;
mod random;
mod shade;
mod sky;
mod surface;
pub mod texture;
mod trace;
pub use camera::Camera;
