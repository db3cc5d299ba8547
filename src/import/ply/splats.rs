//! Reads Gaussians in the layout of the original 3DGS trainer (Kerbl et al. 2023, `save_ply`):
//! x y z, nx ny nz (zero), f_dc_0..2, f_rest_* channel by channel, opacity (logit),
//! scale_0..2 (logarithms), rot_0..3 (w x y z); all f32.

use std::path::Path;

use super::header::Element;
use super::rows::Ply;
use super::{malformed, missing};
use crate::dataset::DatasetError;
use crate::gaussians::{Gaussians, MAX_SH_DEGREE, sh_coefficients};

/// Fraction of the rows that may be unusable.
const MAX_BAD_ROWS: f64 = 0.01;
/// Squared length below which a quaternion counts as zero: 1e-6 of a unit quaternion.
const ZERO_QUATERNION: f32 = 1e-12;

/// A model read from a file, and what was wrong with the file.
#[derive(Debug, Clone, PartialEq)]
pub struct SplatFile {
    /// The rows, in the file's order and coordinates, bit for bit.
    pub gaussians: Gaussians,
    /// Rows dropped because a value was not finite.
    pub dropped: usize,
    /// Rows whose zero quaternion was replaced by the identity.
    pub repaired: usize,
}

/// Reads a splat PLY by any program that keeps the original property names.
///
/// # Errors
/// When the file is unreadable or contradicts itself, a property is missing, the layout is the
/// compressed one, or more than 1 % of the rows are not finite.
pub fn read_splats(path: &Path) -> Result<SplatFile, DatasetError> {
    let mut ply = Ply::open(path)?;
    let packed = |element: &Element| {
        element.name == "chunk" || element.properties.iter().any(|p| p.name == "packed_position")
    };
    if ply.header.elements.iter().any(packed) {
        return Err(DatasetError(format!(
            "{} is a compressed splat PLY (element chunk, packed properties), which densify does not read; \
             export it as an uncompressed .ply, e.g. with SuperSplat or splat-transform",
            path.display()
        )));
    }
    let vertices = ply.element("vertex")?;
    let sh_degree = sh_degree(path, &vertices)?;
    let rest = 3 * (sh_coefficients(sh_degree) - 1);
    let columns = splat_properties(sh_degree)
        .map(|name| column(path, &vertices, &name))
        .collect::<Result<Vec<_>, _>>()?;

    let mut gaussians = Gaussians { sh_degree, ..Gaussians::default() };
    let (mut total, mut dropped, mut repaired) = (0_usize, 0, 0);
    let mut values = vec![0f32; columns.len()];
    ply.each_row(&vertices, &columns, |row| {
        total += 1;
        for (value, &wide) in values.iter_mut().zip(row) {
            *value = wide as f32;
        }
        if values.iter().any(|value| !value.is_finite()) {
            dropped += 1;
            return;
        }
        repaired += usize::from(push(&mut gaussians, &values, rest));
    })?;
    if dropped as f64 > MAX_BAD_ROWS * total as f64 {
        return Err(DatasetError(format!(
            "{}: {dropped} of {total} rows are not finite, more than 1 %; the file is damaged: export it again",
            path.display()
        )));
    }
    Ok(SplatFile { gaussians, dropped, repaired })
}

/// Names of the properties of a row, without the normals, in the order of [`push`].
pub(crate) fn splat_properties(sh_degree: u8) -> impl Iterator<Item = String> {
    let rest = 3 * (sh_coefficients(sh_degree) - 1);
    let named = |names: &[&str]| names.iter().map(|&name| name.to_owned()).collect::<Vec<_>>();
    let numbered =
        |prefix: &str, count: usize| (0..count).map(|i| format!("{prefix}{i}")).collect::<Vec<_>>();
    [
        named(&["x", "y", "z"]),
        numbered("f_dc_", 3),
        numbered("f_rest_", rest),
        named(&["opacity"]),
        numbered("scale_", 3),
        numbered("rot_", 4),
    ]
    .into_iter()
    .flatten()
}

/// Appends a row of [`splat_properties`]; says whether the quaternion had to be replaced.
fn push(gaussians: &mut Gaussians, values: &[f32], rest: usize) -> bool {
    let (position, values) = values.split_at(3);
    let (dc, values) = values.split_at(3);
    let (bands, values) = values.split_at(rest);
    let &[opacity, s0, s1, s2, w, x, y, z] = values else {
        unreachable!("a row of the layout ends with 8 values, not {}", values.len())
    };
    gaussians.means.push([position[0], position[1], position[2]]);
    gaussians.sh.extend_from_slice(dc);
    for k in 0..rest / 3 {
        gaussians.sh.extend([0, 1, 2].map(|channel| bands[channel * (rest / 3) + k]));
    }
    gaussians.opacity_logits.push(opacity);
    gaussians.log_scales.push([s0, s1, s2]);
    let is_zero = w * w + x * x + y * y + z * z < ZERO_QUATERNION;
    gaussians.quats.push(if is_zero { [1.0, 0.0, 0.0, 0.0] } else { [w, x, y, z] });
    is_zero
}

fn column(path: &Path, vertices: &Element, name: &str) -> Result<usize, DatasetError> {
    let remedy = "a splat PLY needs x y z, f_dc_0..2, opacity, scale_0..2 and rot_0..3 \
                  (a point cloud is not a splat file)";
    vertices.find(&[name]).ok_or_else(|| missing(path, name, remedy))
}

fn sh_degree(path: &Path, vertices: &Element) -> Result<u8, DatasetError> {
    let rest = vertices.properties.iter().filter(|p| p.name.starts_with("f_rest_")).count();
    let fits = |degree: &u8| 3 * (sh_coefficients(*degree) - 1) == rest;
    (0..=MAX_SH_DEGREE).find(fits).ok_or_else(|| {
        let problem = format!("there are {rest} of them, but degrees 0 to 3 have 0, 9, 24 or 45");
        malformed(path, "f_rest_*", problem)
    })
}
