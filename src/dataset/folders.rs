//! Where images and masks lie: `images`, `images_2`/`_4`/`_8`, `masks`, or `--images DIR`.

use std::path::{Path, PathBuf};

use super::error::DatasetError;
use super::paths::{Named, Root, relative};
use super::{LoadOptions, Resolution};

/// Endings tried for a name without one, as NeRF-synthetic files write them.
const ENDINGS: [&str; 8] = ["", ".png", ".jpg", ".jpeg", ".webp", ".PNG", ".JPG", ".JPEG"];

/// The folders of one dataset.
#[derive(Debug)]
pub(super) struct Folders {
    root: Root,
    /// What `--images` names.
    chosen: Option<Root>,
    /// `images_K` and K, where `-r K` asks for it and it is there.
    reduced: Option<(Root, u32)>,
    /// Whether names are relative to `images/` (COLMAP) or to the dataset.
    within_images: bool,
}

/// A file found.
#[derive(Debug)]
pub(super) struct Found {
    pub(super) path: PathBuf,
    /// The divisor of the folder `images_K` it was found in.
    pub(super) reduced: Option<u32>,
    /// Whether `images_K` lacked it.
    pub(super) fell_back: bool,
}

impl Folders {
    pub(super) fn new(
        root: &Root,
        options: &LoadOptions,
        within_images: bool,
    ) -> Result<Self, DatasetError> {
        // A folder that the user names may lie anywhere; one that is not absolute lies in the dataset.
        let chosen = options
            .images
            .as_ref()
            .map(|folder| Root::new(&root.path().join(folder)))
            .transpose()?;
        let reduced = match options.resolution {
            Some(Resolution::Divisor(k)) if k > 1 && chosen.is_none() => {
                let folder = root.path().join(format!("images_{k}"));
                if folder.is_dir() { Some((Root::new(&folder)?, k)) } else { None }
            }
            _ => None,
        };
        Ok(Self { root: root.clone(), chosen, reduced, within_images })
    }

    /// The file of an image, if there is one.
    pub(super) fn image(&self, named: Named<'_>) -> Result<Option<Found>, DatasetError> {
        // Checked as written first, so that a path out of the folder is refused in every case.
        self.root.join(named)?;
        let inside = self.inside_images(named.value);
        // COLMAP names files in full.
        let endings = if self.within_images { &ENDINGS[..1] } else { &ENDINGS[..] };
        for ending in endings {
            let within = format!("{inside}{ending}");
            let mut fell_back = false;
            if let Some((folder, k)) = &self.reduced {
                // The folder itself may be a link out of the dataset.
                let below_root = format!("images_{k}/{within}");
                self.root.existing(Named { value: &below_root, ..named })?;
                if let Some(path) = folder.existing(Named { value: &within, ..named })? {
                    return Ok(Some(Found { path, reduced: Some(*k), fell_back: false }));
                }
                fell_back = true;
            }
            let path = match &self.chosen {
                Some(folder) => folder.existing(Named { value: &within, ..named })?,
                None => {
                    let value = self.below_root(named.value) + ending;
                    self.root.existing(Named { value: &value, ..named })?
                }
            };
            if let Some(path) = path {
                return Ok(Some(Found { path, reduced: None, fell_back }));
            }
        }
        Ok(None)
    }

    /// The mask beside an image, if there is one: `masks/NAME.png`, with or without NAME's ending.
    pub(super) fn mask(&self, named: Named<'_>) -> Result<Option<PathBuf>, DatasetError> {
        let inside = self.inside_images(named.value);
        let stem = Path::new(&inside).with_extension("").to_string_lossy().into_owned();
        for value in
            [format!("masks/{inside}.png"), format!("masks/{inside}"), format!("masks/{stem}.png")]
        {
            if let Some(path) = self.root.existing(Named { value: &value, ..named })? {
                return Ok(Some(path));
            }
        }
        Ok(None)
    }

    pub(super) fn missing(&self, named: Named<'_>) -> DatasetError {
        let folder = self.chosen.as_ref().unwrap_or(&self.root);
        let within = if self.chosen.is_some() {
            self.inside_images(named.value)
        } else {
            self.below_root(named.value)
        };
        DatasetError::MissingImage {
            path: named.file.to_owned(),
            field: named.field.to_owned(),
            image: folder.path().join(within),
        }
    }

    pub(super) fn fell_back_note(&self, count: usize) -> String {
        let folder = self.reduced.as_ref().map(|(root, _)| root.path().display().to_string());
        format!(
            "{count} images are not in {} and are shrunk from the full size",
            folder.unwrap_or_default()
        )
    }

    fn inside_images(&self, value: &str) -> String {
        let value = relative(value);
        match value.strip_prefix("images/") {
            Some(inside) if !self.within_images => inside.to_owned(),
            _ => value,
        }
    }

    fn below_root(&self, value: &str) -> String {
        let value = relative(value);
        if self.within_images { format!("images/{value}") } else { value }
    }
}
