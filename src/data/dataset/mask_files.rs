//! Finds mask files by the names that programs give them.
//!
//! COLMAP's and nerfstudio's masks are in `masks/` and folders with similar names; RealityCapture's mask layers,
//! 3DGRUT's masks and instant-ngp's dynamic masks are beside the photographs.

use std::cell::OnceCell;
use std::collections::HashSet;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};

use super::LoadError;
use super::folders::{Folders, ImageFile};
use super::paths::{DataPath, Root};

/// Suffix of RealityCapture's mask layers.
const LAYER: &str = ".mask.png";
/// Suffix of 3DGRUT's masks.
const GRUT: &str = "_mask.png";
/// Prefix of instant-ngp's dynamic masks.
const DYNAMIC: &str = "dynamic_mask_";

/// Names of the dataset's folders of masks, in order of precedence. Upper and lower case are not distinguished.
const FOLDERS: [&str; 4] = ["masks", "mask", "segmentation", "dynamic_masks"];

/// The file of a mask.
#[derive(Debug, Clone)]
pub(super) struct MaskFile {
    pub(super) path: PathBuf,
    /// True if all values but 0 hide a pixel completely; otherwise 0 hides it completely and grey in part.
    pub(super) hides_all_but_black: bool,
    /// The path of another machine that led to the file, if a suffix of it did.
    pub(super) listed: Option<String>,
}

impl MaskFile {
    /// A mask whose black pixels hide those of the photograph.
    pub(super) fn black_hides(path: PathBuf) -> Self {
        Self { path, hides_all_but_black: false, listed: None }
    }
}

/// The photographs that a pose file lists, none of which is the mask of another.
pub(super) struct Listed<'a> {
    /// Folders in which they are looked for.
    folders: &'a [&'a Folders],
    file: &'a Path,
    names: Vec<&'a str>,
    /// Their files, which are looked for only if there may be a mask.
    files: OnceCell<HashSet<PathBuf>>,
}

impl<'a> Listed<'a> {
    pub(super) fn new(
        folders: &'a [&'a Folders],
        file: &'a Path,
        names: impl Iterator<Item = &'a str>,
    ) -> Self {
        Self { folders, file, names: names.collect(), files: OnceCell::new() }
    }

    fn contains(&self, path: &Path) -> bool {
        let files = self.files.get_or_init(|| {
            let each = self.folders.iter().flat_map(|folders| {
                let named =
                    |value: &&'a str| DataPath { file: self.file, field: "the list", value };
                // A path that is refused is reported where its photograph is read.
                let images = self
                    .names
                    .iter()
                    .filter_map(move |value| folders.image(named(value)).ok().flatten());
                images.flat_map(|image| {
                    let (root, places) = folders.image_places(&image);
                    places.into_iter().map(|place| root.path().join(place))
                })
            });
            each.filter_map(|path| path.canonicalize().ok()).collect()
        });
        path.canonicalize().is_ok_and(|path| files.contains(&path))
    }
}

/// Returns true if a file of this name beside photographs is the mask of a photograph.
pub(super) fn is_mask(name: &OsStr) -> bool {
    name.to_str().is_some_and(|name| {
        [LAYER, GRUT].iter().any(|suffix| name.ends_with(suffix)) || name.starts_with(DYNAMIC)
    })
}

/// Returns true if folders of this name contain masks.
pub(super) fn is_mask_folder(name: &str) -> bool {
    precedence(name).is_some()
}

/// The index of a folder's name in [`FOLDERS`], ignoring case.
fn precedence(name: &str) -> Option<usize> {
    FOLDERS.iter().position(|known| known.eq_ignore_ascii_case(name))
}

/// The names of a dataset's folders of masks, in order of precedence.
pub(super) fn folders(dataset: &Path) -> Vec<String> {
    let entries = dataset.read_dir().into_iter().flatten().flatten();
    let names = entries.filter_map(|entry| entry.file_name().into_string().ok());
    let mut folders: Vec<String> =
        names.filter(|name| is_mask_folder(name) && dataset.join(name).is_dir()).collect();
    // Names in lower case come first.
    folders.sort_by_cached_key(|name| (precedence(name), std::cmp::Reverse(name.clone())));
    folders
}

/// Note about a folder of masks, for datasets in which no photograph has a mask.
pub(super) fn unused_masks_note(dataset: &Path) -> Option<String> {
    let holds_files = |folder: &PathBuf| {
        folder.read_dir().is_ok_and(|mut entries| entries.any(|entry| entry.is_ok()))
    };
    let all = folders(dataset).into_iter().map(|name| dataset.join(name));
    let folder = all.chain([dataset.join("images/masks")]).find(holds_files)?;
    Some(format!(
        "{} contains no mask of any photograph: masks belong in the dataset's folder `masks/`, in the same subfolders as \
         the photographs and named after them as NAME.EXT.png or NAME.png",
        folder.display()
    ))
}

impl Folders {
    /// The mask of an image, if there is one. Masks in `masks/` take precedence over those beside the image.
    pub(super) fn mask(
        &self,
        image: &ImageFile,
        named: DataPath<'_>,
        photographs: &Listed<'_>,
    ) -> Result<Option<MaskFile>, LoadError> {
        let at = |root: &Root, value: String| {
            let found = root.existing(DataPath { value: &value, ..named })?;
            Ok::<_, LoadError>(found.filter(|path| !photographs.contains(path)))
        };
        // The file's name has an extension, which the listed name may lack.
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
        for folder in &self.mask_folders {
            for name in &names {
                if let Some(path) = at(&self.root, format!("{folder}/{name}"))? {
                    return Ok(Some(MaskFile::black_hides(path)));
                }
            }
        }
        let (root, places) = self.image_places(image);
        for place in places {
            for value in [
                format!("{file}{LAYER}"),
                format!("{stem}{LAYER}"),
                format!("{stem}{GRUT}"),
                format!(".mask/{stem}.png"),
                format!("{DYNAMIC}{stem}.png"),
            ] {
                if let Some(path) = at(root, with_file_name(&place, &value))? {
                    let hides_all_but_black = value.starts_with(DYNAMIC);
                    return Ok(Some(MaskFile { path, hides_all_but_black, listed: None }));
                }
            }
        }
        Ok(None)
    }

    /// The root folder of an image and, below this folder, the paths of the image and of its full-size original.
    fn image_places(&self, image: &ImageFile) -> (&Root, Vec<String>) {
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

/// Replaces the file name of a path.
fn with_file_name(path: &str, file: &str) -> String {
    match path.rsplit_once('/') {
        Some((folder, _)) => format!("{folder}/{file}"),
        None => file.to_owned(),
    }
}

fn stem(file: &str) -> &str {
    Path::new(file).file_stem().and_then(OsStr::to_str).unwrap_or(file)
}
