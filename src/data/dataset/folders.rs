//! Finds image files in `images`, `images_2`/`_4`/`_8`, or the folder given by `--images`.

use std::collections::HashSet;
use std::fs;
use std::path::{Path, PathBuf};

use unicode_normalization::UnicodeNormalization;

use super::LoadError;
use super::depth::DepthChoice;
use super::mask_files;
use super::paths::{DataPath, PHOTOGRAPHS, Root, is_absolute, namesake, relative};
use super::{Frame, LoadOptions, Resolution};

/// Extensions that are tried for names without one, as in NeRF-synthetic files.
const EXTENSIONS: [&str; 8] = ["", ".png", ".jpg", ".jpeg", ".webp", ".PNG", ".JPG", ".JPEG"];

/// The folders of one dataset.
#[derive(Debug)]
pub(super) struct Folders {
    pub(super) root: Root,
    /// The folder given by `--images`.
    pub(super) chosen: Option<Root>,
    /// The names of the folders of masks, in order of precedence.
    pub(super) mask_folders: Vec<String>,
    /// The folder `images_K` and K, if requested by `-r K` and present.
    reduced: Option<(Root, u32)>,
    /// True if names are relative to `images/`, as in COLMAP models, rather than to the dataset's folder.
    within_images: bool,
    /// True if depth is looked for.
    pub(super) reads_depth: bool,
}

/// The file of an image.
#[derive(Debug)]
pub(super) struct ImageFile {
    /// Name of the view: the path as listed, or the part of an absolute path that exists below `--images`.
    pub(super) name: String,
    pub(super) path: PathBuf,
    /// K, if the file is in the folder `images_K`.
    pub(super) reduced: Option<u32>,
    /// True if the file is missing in `images_K`, so that the full-size image is shrunk instead.
    pub(super) fell_back: bool,
}

impl Folders {
    pub(super) fn new(
        root: &Root,
        options: &LoadOptions,
        within_images: bool,
    ) -> Result<Self, LoadError> {
        // The user may name any folder; a relative path is relative to the dataset.
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
        let mask_folders = mask_files::folders(root.path());
        let reads_depth =
            options.depth.choice != DepthChoice::Off && options.depth.points.is_none();
        Ok(Self { root: root.clone(), chosen, mask_folders, reduced, within_images, reads_depth })
    }

    /// The file of an image, if there is one.
    pub(super) fn image(&self, named: DataPath<'_>) -> Result<Option<ImageFile>, LoadError> {
        if let Some(folder) = self.folder_for_absolute(named.value) {
            return self.image_by_suffix(folder, named);
        }
        match self.image_as_listed(named)? {
            // Programs on Windows write backslashes.
            None if named.value.contains('\\') => {
                let value = named.value.replace('\\', "/");
                self.image_as_listed(DataPath { value: &value, ..named })
            }
            found => Ok(found),
        }
    }

    /// The folder given by `--images`, if `value` is an absolute path. Such paths mostly come from another machine.
    pub(super) fn folder_for_absolute(&self, value: &str) -> Option<&Root> {
        self.chosen.as_ref().filter(|_| is_absolute(value))
    }

    fn image_as_listed(&self, named: DataPath<'_>) -> Result<Option<ImageFile>, LoadError> {
        // A path that leads out of the folder is refused even if no such file exists.
        self.root.join(named)?;
        let (name, inside) = (relative(named.value), self.inside_images(named.value));
        for ending in self.endings() {
            let within = format!("{inside}{ending}");
            let mut fell_back = false;
            if let Some((folder, k)) = &self.reduced {
                // Refuses a folder that is itself a link out of the dataset.
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

    /// The image in `folder` at the longest suffix of an absolute path that exists there.
    fn image_by_suffix(
        &self,
        folder: &Root,
        named: DataPath<'_>,
    ) -> Result<Option<ImageFile>, LoadError> {
        for name in named.suffixes()? {
            for ending in self.endings() {
                let value = format!("{name}{ending}");
                if let Some(path) = folder.existing(DataPath { value: &value, ..named })? {
                    return Ok(Some(ImageFile { name, path, reduced: None, fell_back: false }));
                }
            }
        }
        Ok(None)
    }

    /// Extensions to try; names in COLMAP models always have one.
    fn endings(&self) -> &'static [&'static str] {
        if self.within_images { &EXTENSIONS[..1] } else { &EXTENSIONS }
    }

    pub(super) fn missing(&self, named: DataPath<'_>) -> LoadError {
        let image = self.shown_path(named);
        LoadError::missing_image(named.file, named.field, &image, namesake(&image).as_deref())
    }

    /// The path that messages name for a missing image: the first one tried, or the bare file name in `--images` if
    /// the listed path is absolute.
    pub(super) fn shown_path(&self, named: DataPath<'_>) -> PathBuf {
        match &self.chosen {
            Some(folder) if is_absolute(named.value) => {
                let last = named.suffixes().ok().and_then(Iterator::last);
                folder.path().join(last.unwrap_or_default())
            }
            Some(folder) => folder.path().join(self.inside_images(named.value)),
            None => self.root.path().join(self.below_root(named.value)),
        }
    }

    /// Number of photographs in the folder of images that no frame uses.
    pub(super) fn count_others(&self, frames: &[Frame]) -> usize {
        let images = self.root.path().join("images");
        let folder = match (&self.chosen, &self.reduced) {
            (Some(chosen), _) => chosen.path(),
            (None, Some((reduced, _))) if !images.is_dir() => reduced.path(),
            _ => &images,
        };
        let mut names = Vec::new();
        // If the dataset lies in the chosen folder, that folder's subfolders are not searched for further photographs.
        let is_deep = !self.chosen.as_ref().is_some_and(|folder| folder.contains(&self.root));
        add_photographs(folder, "", is_deep, &mut names);
        // A name may have several Unicode spellings, and its extension may be in upper or lower case.
        let spelled = |name: &str| name.nfc().collect::<String>().to_ascii_lowercase();
        let used: HashSet<String> = frames.iter().map(|frame| spelled(&frame.name)).collect();
        names.iter().filter(|name| !used.contains(&spelled(name))).count()
    }

    pub(super) fn fell_back_note(&self, count: usize) -> String {
        let folder = self.reduced.as_ref().map(|(root, _)| root.path().display().to_string());
        format!(
            "{count} images are not in {} and are shrunk from full size instead",
            folder.unwrap_or_default()
        )
    }

    /// The path of an image inside its folder of images.
    pub(super) fn inside_images(&self, value: &str) -> String {
        let value = relative(value);
        match value.strip_prefix("images/") {
            Some(inside) if !self.within_images => inside.to_owned(),
            _ => value,
        }
    }

    /// The path of an image below the dataset's folder.
    pub(super) fn below_root(&self, value: &str) -> String {
        let value = relative(value);
        if self.within_images { format!("images/{value}") } else { value }
    }
}

/// Adds the names of the photographs in a folder and, if `is_deep`, in its subfolders, except masks and hidden files.
fn add_photographs(folder: &Path, inside: &str, is_deep: bool, names: &mut Vec<String>) {
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        let file = entry.file_name();
        let name = file.to_string_lossy();
        let path = format!("{inside}{name}");
        if name.starts_with('.') || mask_files::is_mask(&file) {
            continue;
        }
        let is_photograph = || {
            let ending = Path::new(&file).extension().unwrap_or_default().to_ascii_lowercase();
            PHOTOGRAPHS.iter().any(|known| ending == *known)
        };
        if entry.file_type().is_ok_and(|kind| kind.is_dir()) {
            if is_deep && !mask_files::is_mask_folder(&name) {
                add_photographs(&entry.path(), &format!("{path}/"), true, names);
            }
        } else if is_photograph() {
            names.push(path);
        }
    }
}
