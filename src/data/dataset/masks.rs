//! Finds the files of masks by the names that programs give them.
//!
//! In `masks/` and folders of similar names: COLMAP's and nerfstudio's names. Beside the photograph: the layers of RealityCapture, and the dynamic
//! masks of instant-ngp.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};

use super::DatasetError;
use super::folders::{Folders, ImageFile};
use super::paths::{DataPath, Root};

/// How the name of a mask ends that is a layer of RealityCapture, and how that of instant-ngp begins.
const LAYER: &str = ".mask.png";
const DYNAMIC: &str = "dynamic_mask_";

/// Folders of the dataset that hold masks; the first of them that has one of an image counts.
const FOLDERS: [&str; 4] = ["masks", "mask", "segmentation", "dynamic_masks"];

/// The file of a mask.
#[derive(Debug, Clone)]
pub(super) struct MaskFile {
    pub(super) path: PathBuf,
    /// Whether every value but 0 hides a pixel, instead of 0 alone doing it wholly.
    pub(super) hides_all_but_black: bool,
}

impl MaskFile {
    /// A mask that hides where it is black.
    pub(super) fn of(path: PathBuf) -> Self {
        Self { path, hides_all_but_black: false }
    }
}

/// Whether a file beside photographs is a mask of one.
pub(super) fn is_mask(name: &OsStr) -> bool {
    name.to_str().is_some_and(|name| name.ends_with(LAYER) || name.starts_with(DYNAMIC))
}

/// What is said where there is a folder for masks and no photograph has one.
pub(super) fn unused_masks_note(dataset: &Path) -> Option<String> {
    let holds_files = |folder: &PathBuf| {
        folder.read_dir().is_ok_and(|mut entries| entries.any(|entry| entry.is_ok()))
    };
    let all = FOLDERS.map(|name| dataset.join(name));
    let folder = all.into_iter().chain([dataset.join("images/masks")]).find(holds_files)?;
    Some(format!(
        "{} holds the mask of no photograph: masks lie in `masks/` of the dataset, each NAME.EXT.png or NAME.png \
         after its photograph, below the same folders",
        folder.display()
    ))
}

impl Folders {
    /// The mask of an image, if there is one. What lies in `masks/` precedes what lies beside the image.
    pub(super) fn mask(
        &self,
        image: &ImageFile,
        named: DataPath<'_>,
    ) -> Result<Option<MaskFile>, DatasetError> {
        let at = |root: &Root, value: String| root.existing(DataPath { value: &value, ..named });
        // With the ending of the file, which the listed name may lack.
        let listed = self.inside_images(&image.name);
        let file = image.path.file_name().and_then(OsStr::to_str).unwrap_or_default();
        let (inside, stem) = (with_file_name(&listed, file), stem(file));
        let renamed = |ending: &str| with_file_name(&listed, &format!("{stem}{ending}"));
        let names = [
            format!("{inside}.png"),
            inside.clone(),
            renamed(".png"),
            renamed(".jpg"),
            renamed(".jpeg"),
            format!("{inside}{LAYER}"),
            renamed(LAYER),
        ];
        for folder in FOLDERS.iter().filter(|folder| self.root.path().join(folder).is_dir()) {
            for name in &names {
                if let Some(path) = at(&self.root, format!("{folder}/{name}"))? {
                    return Ok(Some(MaskFile::of(path)));
                }
            }
        }
        let (root, places) = self.beside(image);
        for place in places {
            for value in [
                format!("{file}{LAYER}"),
                format!("{stem}{LAYER}"),
                format!(".mask/{stem}.png"),
                format!("{DYNAMIC}{stem}.png"),
            ] {
                if let Some(path) = at(root, with_file_name(&place, &value))? {
                    let hides_all_but_black = value.starts_with(DYNAMIC);
                    return Ok(Some(MaskFile { path, hides_all_but_black }));
                }
            }
        }
        Ok(None)
    }

    /// The folder that holds an image, and where below it the image lies, and would lie at its full size.
    fn beside(&self, image: &ImageFile) -> (&Root, Vec<String>) {
        let root = self.chosen.as_ref().unwrap_or(&self.root);
        let path = image.path.strip_prefix(root.path()).unwrap_or(&image.path);
        let path = path.to_string_lossy().replace(std::path::MAIN_SEPARATOR, "/");
        let mut places = vec![path];
        if image.reduced.is_some() {
            places.push(self.below_root(&image.name));
        }
        (root, places)
    }
}

/// The path with another name of the file.
fn with_file_name(path: &str, file: &str) -> String {
    match path.rsplit_once('/') {
        Some((folder, _)) => format!("{folder}/{file}"),
        None => file.to_owned(),
    }
}

fn stem(file: &str) -> &str {
    Path::new(file).file_stem().and_then(OsStr::to_str).unwrap_or(file)
}
