//! Reads datasets and models of Gaussian splats in all formats, which are untrusted, and writes models. Independent of
//! backends and runs.

pub mod dataset;
pub mod export;
pub mod import;
pub mod track_colours;
pub mod views;
