//! Readers of other programs' files (datasets and models of Gaussian splats in all formats), and writers of models.
//! This layer depends on neither backends nor runs.
//!
//! Its modules in order, each using only those before it: `error`, `picture_file`, `ply`, [`meshes`], [`models`], [`points`],
//! [`las`], [`dataset`], [`track_colours`], [`track_poses`] and [`views`].

pub mod dataset;
mod error;
pub mod las;
pub mod meshes;
pub mod models;
mod picture_file;
mod ply;
pub mod points;
pub mod track_colours;
pub mod track_poses;
pub mod views;

pub use error::{DepthRemedy, LoadError, LoadRemedy};
