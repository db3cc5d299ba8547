//! Everything that opens strangers' files: datasets, and models of Gaussian splats in all formats; and the writers
//! of those formats. Knows no backend and no run.

pub mod dataset;
pub mod export;
pub mod import;
pub mod track_colours;
pub mod views;
