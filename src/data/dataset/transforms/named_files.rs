//! The files that the JSON names beside the photographs: masks and initial points.

use std::io::Read;
use std::path::{Path, PathBuf};

use super::super::LoadError;
use super::super::depth::DepthFile;
use super::super::folders::{Folders, ImageFile};
use super::super::mask_files::{Listed, MaskFile};
use super::super::paths::{DataPath, Root, namesake, relative};
use super::DeclaredSplit;
use super::fields::Fields;
use densify_core::files;

/// File names of initial points that the JSON need not name, in order of precedence: those of 3DGS, nerfstudio,
/// LichtFeld Studio and Brush.
const POINT_FILES: [&str; 5] =
    ["points3d.ply", "sparse_pc.ply", "points3D.ply", "pointcloud.ply", "init.ply"];
/// First bytes of every PLY file.
const PLY: &[u8] = b"ply";

/// The file of the initial points: the one named in the JSON, or one of [`POINT_FILES`].
pub(super) fn points_file(
    (root, folders): (&Root, &Folders),
    top: &Fields<'_>,
    declared: DeclaredSplit,
    notes: &mut Vec<String>,
) -> Result<Option<PathBuf>, LoadError> {
    if let Some(value) = top.text("ply_file_path")? {
        let named = DataPath { file: top.path, field: "ply_file_path", value };
        if folders.folder_for_absolute(value).is_none() {
            let missing =
                || top.fault("ply_file_path", format!("the file {value:?} does not exist"));
            let found = root.existing_on_any_system(named)?.ok_or_else(missing)?;
            return check_is_ply(named, &found).map(|()| Some(found));
        }
        // The path is from another machine; the file may have been copied along with the photographs.
        for value in named.suffixes()? {
            if let Some(found) = root.existing(DataPath { value: &value, ..named })? {
                return check_is_ply(named, &found).map(|()| Some(found));
            }
        }
        let file = top.path.file_name().unwrap_or_default().display();
        notes.push(files::one_line(&format!(
            "{file}: the initial points {value:?} are not in the dataset's folder and are left out"
        )));
    }
    if declared == DeclaredSplit::Test { Ok(None) } else { usual_points(root, top.path, notes) }
}

/// Refuses initial points of another format, which cannot be read even if they are whole.
fn check_is_ply(named: DataPath<'_>, found: &Path) -> Result<(), LoadError> {
    let is_named_ply = found.extension().is_some_and(|name| name.eq_ignore_ascii_case("ply"));
    let mut start = Vec::new();
    let file = files::open(found).map_err(LoadError::io(found))?;
    file.take(PLY.len() as u64).read_to_end(&mut start).map_err(LoadError::io(found))?;
    if is_named_ply || start == PLY {
        return Ok(());
    }
    let problem = format!("{:?} is not a PLY file", named.value);
    Err(LoadError::malformed(named.file, named.field, problem, "convert the points to PLY"))
}

/// The file of initial points under one of the [usual names](POINT_FILES), for pose files that name none.
pub(in super::super) fn usual_points(
    root: &Root,
    file: &Path,
    notes: &mut Vec<String>,
) -> Result<Option<PathBuf>, LoadError> {
    for value in POINT_FILES {
        if let Some(found) = root.existing(DataPath { file, field: "initial points", value })? {
            notes.push(format!("initial points are taken from {value}"));
            return Ok(Some(found));
        }
    }
    Ok(None)
}

impl Fields<'_> {
    /// The depth file that a frame names, or that lies in a usual place, if depth is read. A missing file is not an error,
    /// as depth may be left out.
    pub(super) fn depth(
        &self,
        (root, folders): (&Root, &Folders),
        image: &ImageFile,
        photograph: DataPath<'_>,
    ) -> Result<Option<DepthFile>, LoadError> {
        if !folders.reads_depth {
            return Ok(None);
        }
        let Some(value) = self.text("depth_file_path")? else {
            return folders.depth(image, photograph);
        };
        let field = self.full("depth_file_path");
        let named = DataPath { file: self.path, field: &field, value };
        let found = if folders.folder_for_absolute(value).is_some() {
            let mut found = None;
            for value in named.suffixes()?.filter(|end| end.contains('/')) {
                found = found.or(root.existing(DataPath { value: &value, ..named })?);
            }
            found
        } else {
            root.existing_on_any_system(named)?
        };
        let Some(path) = found else { return folders.depth(image, photograph) };
        let Some(depth) = DepthFile::new(path) else {
            let problem = format!("{value:?} is no PNG, NumPy or OpenEXR file");
            return Err(self.fault("depth_file_path", problem));
        };
        let unit = self.number("depth_unit_scale_factor")?;
        if unit.is_some_and(|unit| !(unit > 0.0 && unit.is_normal())) {
            return Err(self.fault("depth_unit_scale_factor", "it is not a positive number"));
        }
        Ok(Some(DepthFile { unit, ..depth }.with_confidence(root, named)?))
    }

    /// The mask that a frame names.
    pub(super) fn mask(
        &self,
        (root, folders, listed): (&Root, &Folders, &Listed<'_>),
        image: &ImageFile,
        value: &str,
    ) -> Result<MaskFile, LoadError> {
        let field = self.full("mask_path");
        let named = DataPath { file: self.path, field: &field, value };
        if folders.folder_for_absolute(value).is_none() {
            let missing = || {
                let place = root.path().join(relative(value));
                LoadError::missing_image(self.path, &field, &place, namesake(&place).as_deref())
            };
            return Ok(MaskFile::black_hides(
                root.existing_on_any_system(named)?.ok_or_else(missing)?,
            ));
        }
        // The path is from another machine: its suffixes are looked for in the dataset's folder, then the usual places
        // of masks are searched. The bare file name does not count, as a photograph may have the same name.
        for value in named.suffixes()?.filter(|end| end.contains('/')) {
            if let Some(found) = root.existing(DataPath { value: &value, ..named })? {
                let listed = Some(named.value.to_owned());
                return Ok(MaskFile { listed, ..MaskFile::black_hides(found) });
            }
        }
        folders.mask(image, named, listed)?.ok_or_else(|| {
            let problem = format!("the mask {value:?} is not in the dataset's folder");
            let remedy =
                "put it into `masks/` there, under the photograph's name, or remove the field";
            LoadError::malformed(self.path, &field, problem, remedy)
        })
    }
}
