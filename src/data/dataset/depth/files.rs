//! Finds depth files by the names that programs give them.
//!
//! `transforms.json` names them itself. Otherwise they are in `depth/` or `depths/` of the dataset, or beside the folder
//! of the photographs, as in recordings of Polycam, Stray Scanner, ARKitScenes and ScanNet; dense COLMAP models have
//! `stereo/depth_maps/`. Confidences are in `confidence/` beside the folder of depth.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};

use super::super::LoadError;
use super::super::folders::{Folders, ImageFile};
use super::super::paths::{DataPath, Root};

/// The depth file of a photograph.
#[derive(Debug, Clone, PartialEq)]
pub(in super::super) struct DepthFile {
    pub(in super::super) path: PathBuf,
    pub(in super::super) kind: DepthKind,
    /// Unit that the file of poses states `[world units]`.
    pub(in super::super) unit: Option<f64>,
    /// Scale and offset that turn values, as shares of 65,536, into inverse depth `[1/world units]`.
    pub(in super::super) inverse: Option<[f64; 2]>,
    pub(in super::super) confidence: Option<PathBuf>,
}

/// The format of a depth file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in super::super) enum DepthKind {
    Png,
    Npy,
    Exr,
    Colmap,
}

impl DepthKind {
    /// The formats that file names distinguish, with their extensions.
    const BY_EXTENSION: [(Self, &str); 3] =
        [(Self::Npy, "npy"), (Self::Png, "png"), (Self::Exr, "exr")];

    /// The format of a file, by its name.
    pub(in super::super) fn of(path: &Path) -> Option<Self> {
        let ending = path.extension()?.to_str()?.to_ascii_lowercase();
        let is_colmap = ending == "bin";
        let known = Self::BY_EXTENSION.iter().find(|(_, known)| *known == ending);
        known.map(|(kind, _)| *kind).or(is_colmap.then_some(Self::Colmap))
    }

    /// Length of one step of the values, unless it is stated `[world units]`.
    pub(in super::super) fn unit(self) -> f64 {
        match self {
            Self::Png | Self::Npy => 0.001,
            Self::Exr | Self::Colmap => 1.0,
        }
    }
}

/// Names of folders of depth.
const FOLDERS: [&str; 2] = ["depth", "depths"];
/// Names of folders of photographs beside which there may be a folder of depth.
const PHOTOGRAPHS: [&str; 5] = ["images", "corrected_images", "rgb", "color", "image"];
/// COLMAP's folder of depth maps, and the suffix of those that agree between views.
const COLMAP: (&str, &str) = ("stereo/depth_maps", ".geometric.bin");
const CONFIDENCE: &str = "confidence";

impl DepthFile {
    /// A depth file without further statements; `None` if the format is unknown.
    pub(in super::super) fn new(path: PathBuf) -> Option<Self> {
        let kind = DepthKind::of(&path)?;
        Some(Self { path, kind, unit: None, inverse: None, confidence: None })
    }

    /// Looks for the file of confidences beside the folder of this file.
    pub(in super::super) fn with_confidence(
        self,
        root: &Root,
        named: DataPath<'_>,
    ) -> Result<Self, LoadError> {
        let (Some(stem), Some(inside)) = (stem(&self.path), inside(root, &self.path)) else {
            return Ok(self);
        };
        let folder = inside.rsplit_once('/').map_or("", |(folder, _)| folder);
        // `depth/a/0.png` may have its confidence in `confidence/a/0.png`, and `a/depth/0.png` in `a/confidence/0.png`.
        let parts: Vec<&str> = folder.split('/').collect();
        let Some(at) = parts.iter().rposition(|part| FOLDERS.contains(part)) else {
            return Ok(self);
        };
        let mut places = parts;
        places[at] = CONFIDENCE;
        let value = format!("{}/{stem}.png", places.join("/"));
        let confidence = root.existing(DataPath { value: &value, ..named })?;
        Ok(Self { confidence, ..self })
    }
}

impl Folders {
    /// The depth of an image, if it is looked for and there is any.
    pub(in super::super) fn depth(
        &self,
        image: &ImageFile,
        named: DataPath<'_>,
    ) -> Result<Option<DepthFile>, LoadError> {
        if !self.reads_depth {
            return Ok(None);
        }
        let at = |value: String| self.root.existing(DataPath { value: &value, ..named });
        let listed = self.inside_images(&image.name);
        let name = image.path.file_name().and_then(OsStr::to_str).unwrap_or_default();
        let Some(stem) = stem(&image.path) else { return Ok(None) };
        let folder = listed.rsplit_once('/').map(|(folder, _)| folder);
        let within = |place: &str, file: &str| match folder {
            Some(folder) => format!("{place}/{folder}/{file}"),
            None => format!("{place}/{file}"),
        };
        let mut places: Vec<String> = FOLDERS.iter().map(|place| within(place, "")).collect();
        // Beside the folder of the photographs: `keyframes/images/0.jpg` has `keyframes/depth/0.png`.
        let parts: Vec<&str> = folder.map_or_else(Vec::new, |folder| folder.split('/').collect());
        if let Some((_, outer)) = parts.split_last().filter(|(last, _)| PHOTOGRAPHS.contains(last))
        {
            let beside = |place: &&str| {
                outer.iter().chain([place]).fold(String::new(), |path, part| path + part + "/")
            };
            places.extend(FOLDERS.iter().map(beside));
        }
        for place in places {
            for file in [stem, name] {
                for (_, ending) in DepthKind::BY_EXTENSION {
                    if let Some(path) = at(format!("{place}{file}.{ending}"))? {
                        let found = DepthFile::new(path);
                        return found
                            .map(|file| file.with_confidence(&self.root, named))
                            .transpose();
                    }
                }
            }
        }
        let (place, suffix) = COLMAP;
        Ok(at(within(place, &format!("{name}{suffix}")))?.and_then(DepthFile::new))
    }
}

fn stem(path: &Path) -> Option<&str> {
    path.file_stem().and_then(OsStr::to_str)
}

/// The path of a file below a root, with `/` as separator.
fn inside(root: &Root, path: &Path) -> Option<String> {
    let path = path.strip_prefix(root.path()).ok()?.to_str()?;
    Some(path.replace(std::path::MAIN_SEPARATOR, "/"))
}
