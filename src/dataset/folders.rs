//! Finds the files of images and masks: `images`, `images_2`/`_4`/`_8`, `masks`, or `--images DIR`.

use std::path::{Path, PathBuf};

use super::error::DatasetError;
use super::paths::{DataPath, Root, is_absolute, relative};
use super::{LoadOptions, Resolution};

/// Extensions tried for names without one, as in NeRF-synthetic files.
const ENDINGS: [&str; 8] = ["", ".png", ".jpg", ".jpeg", ".webp", ".PNG", ".JPG", ".JPEG"];

/// The folders of one dataset.
#[derive(Debug)]
pub(super) struct Folders {
    root: Root,
    /// The folder named by `--images`.
    chosen: Option<Root>,
    /// `images_K` and K, if requested by `-r K` and present.
    reduced: Option<(Root, u32)>,
    /// Whether names are relative to `images/` (COLMAP) or to the dataset.
    within_images: bool,
}

/// The file of an image.
#[derive(Debug)]
pub(super) struct ImageFile {
    /// The name of its view: its path as listed, or what of an absolute one is below `--images`.
    pub(super) name: String,
    pub(super) path: PathBuf,
    /// K, if it is in the folder `images_K`.
    pub(super) reduced: Option<u32>,
    /// Whether it is missing in `images_K`, and the full size is used instead.
    pub(super) fell_back: bool,
}

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

impl Folders {
    pub(super) fn new(
        root: &Root,
        options: &LoadOptions,
        within_images: bool,
    ) -> Result<Self, DatasetError> {
        // A folder named by the user may be anywhere; a relative one is relative to the dataset.
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
    pub(super) fn image(&self, named: DataPath<'_>) -> Result<Option<ImageFile>, DatasetError> {
        if let Some(folder) = self.chosen.as_ref().filter(|_| is_absolute(named.value)) {
            return moved(folder, named);
        }
        // Checked as written first: a path out of the folder is refused even if no file is there.
        self.root.join(named)?;
        let (name, inside) = (relative(named.value), self.inside_images(named.value));
        // COLMAP names files in full.
        let endings = if self.within_images { &ENDINGS[..1] } else { &ENDINGS[..] };
        for ending in endings {
            let within = format!("{inside}{ending}");
            let mut fell_back = false;
            if let Some((folder, k)) = &self.reduced {
                // The folder itself may be a link out of the dataset.
                let below_root = format!("images_{k}/{within}");
                self.root.existing(DataPath { value: &below_root, ..named })?;
                if let Some(path) = folder.existing(DataPath { value: &within, ..named })? {
                    let reduced = Some(*k);
                    return Ok(Some(ImageFile { name, path, reduced, fell_back: false }));
                }
                fell_back = true;
            }
            let path = match &self.chosen {
                Some(folder) => folder.existing(DataPath { value: &within, ..named })?,
                None => {
                    let value = self.below_root(named.value) + ending;
                    self.root.existing(DataPath { value: &value, ..named })?
                }
            };
            if let Some(path) = path {
                return Ok(Some(ImageFile { name, path, reduced: None, fell_back }));
            }
        }
        Ok(None)
    }

    /// The mask of the image NAME, if there is one: `masks/NAME.png`, with or without the extension of NAME; or
    /// `dynamic_mask_NAME.png` beside the image, as instant-ngp has it, where all but black is hidden.
    pub(super) fn mask(
        &self,
        name: &str,
        named: DataPath<'_>,
    ) -> Result<Option<MaskFile>, DatasetError> {
        let inside = self.inside_images(name);
        let stem = Path::new(&inside).with_extension("").to_string_lossy().into_owned();
        for value in
            [format!("masks/{inside}.png"), format!("masks/{inside}"), format!("masks/{stem}.png")]
        {
            if let Some(path) = self.root.existing(DataPath { value: &value, ..named })? {
                return Ok(Some(MaskFile::of(path)));
            }
        }
        let image = self.below_root(name);
        let image = Path::new(&image);
        let Some(stem) = image.file_stem().and_then(|stem| stem.to_str()) else { return Ok(None) };
        let beside = image.with_file_name(format!("dynamic_mask_{stem}.png"));
        let value = beside.to_string_lossy();
        let path = self.root.existing(DataPath { value: &value, ..named })?;
        Ok(path.map(|path| MaskFile { path, hides_all_but_black: true }))
    }

    pub(super) fn missing(&self, named: DataPath<'_>) -> DatasetError {
        DatasetError::missing_image(named.file, named.field, &self.place(named))
    }

    /// Where an image is looked for first.
    pub(super) fn place(&self, named: DataPath<'_>) -> PathBuf {
        match &self.chosen {
            Some(folder) if is_absolute(named.value) => {
                folder.path().join(parts(named.value).last().unwrap_or_default())
            }
            Some(folder) => folder.path().join(self.inside_images(named.value)),
            None => self.root.path().join(self.below_root(named.value)),
        }
    }

    /// How many files lie directly in the folder of the images.
    pub(super) fn count(&self) -> usize {
        let images = || self.root.path().join("images");
        let folder = self.chosen.as_ref().map_or_else(images, |folder| folder.path().to_owned());
        let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
        entries.filter(|entry| entry.file_type().is_ok_and(|kind| !kind.is_dir())).count()
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

/// The image of an absolute path, in the folder that the user names: programs write where photographs lay on their
/// own machine. As many of its last parts count as are found.
fn moved(folder: &Root, named: DataPath<'_>) -> Result<Option<ImageFile>, DatasetError> {
    let parts: Vec<&str> = parts(named.value).collect();
    for first in 0..parts.len() {
        let name = parts[first..].join("/");
        if let Some(path) = folder.existing(DataPath { value: &name, ..named })? {
            return Ok(Some(ImageFile { name, path, reduced: None, fell_back: false }));
        }
    }
    Ok(None)
}

/// The parts of an absolute path of any system, without its drive or scheme.
fn parts(value: &str) -> impl Iterator<Item = &str> {
    let drive = |part: &str| part.ends_with(':');
    let parts = value.split(['/', '\\']).filter(|part| !part.is_empty() && *part != ".");
    parts.enumerate().filter(move |(i, part)| *i > 0 || !drive(part)).map(|(_, part)| part)
}
