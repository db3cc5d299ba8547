//! Posed images as one type, whatever format they come from.

pub mod images;
pub mod normalise;

use std::path::PathBuf;

use glam::DVec3;

use crate::camera::Camera;
use normalise::Normalisation;

/// A scene ready for training: cameras and points in normalised coordinates.
#[derive(Debug)]
pub struct Dataset {
    /// Folder that holds it; no image lies outside.
    pub root: PathBuf,
    /// Views to train on, sorted by name; never empty.
    pub train: Vec<View>,
    /// Views held out, sorted by name.
    pub test: Vec<View>,
    /// Points of the reconstruction, if the dataset has any.
    pub points: PointCloud,
    /// From the dataset's own coordinates to the normalised ones used here.
    pub normalisation: Normalisation,
    /// What was noticed while loading and may interest the user (dropped points, missing frames).
    pub notes: Vec<String>,
}

/// One posed image.
#[derive(Debug, Clone)]
pub struct View {
    /// Name as in the dataset, unique, with `/` as separator.
    pub name: String,
    /// Camera at training resolution, in normalised coordinates.
    pub camera: Camera,
    /// How to get the pixels.
    pub source: images::ImageSource,
}

/// A coloured point cloud in structure of arrays.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PointCloud {
    /// Positions. Shape: [points].
    pub positions: Vec<DVec3>,
    /// sRGB colours. Shape: [points].
    pub colours: Vec<[u8; 3]>,
}
