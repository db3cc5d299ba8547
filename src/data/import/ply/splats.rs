//! Reads Gaussians in the layout of the original 3DGS trainer (Kerbl et al. 2023, `save_ply`):
//! x y z, nx ny nz (zero), f_dc_0..2, f_rest_* channel by channel, opacity (logit),
//! scale_0..2 (logarithms), rot_0..3 (w x y z); all f32.

use std::path::Path;

use super::header::Element;
use super::rows::Ply;
use super::{malformed, missing};
use crate::dataset::DatasetError;
use crate::import::SplatFile;
use crate::import::model::{Row, Rows};
use densify_core::gaussians::{MAX_SH_DEGREE, sh_coefficients};

/// Reads a splat PLY by any program that keeps the original property names.
///
/// # Errors
/// When the file is unreadable or contradicts itself, a property is missing (as in the compressed
/// layout, which [`read_model`](crate::import::read_model) reads), or more than 1 % of the rows are not finite.
pub fn read_splats(path: &Path) -> Result<SplatFile, DatasetError> {
    let mut ply = Ply::open(path)?;
    let vertices = ply.element("vertex")?;
    let sh_degree = sh_degree(path, &vertices)?;
    let rest = 3 * (sh_coefficients(sh_degree) - 1);
    let columns = splat_properties(sh_degree)
        .map(|name| column(path, &vertices, &name))
        .collect::<Result<Vec<_>, _>>()?;

    let mut rows = Rows::new(sh_degree);
    let mut values = vec![0f32; columns.len()];
    let mut sh = Vec::with_capacity(3 + rest);
    ply.each_row(&vertices, &columns, |row| {
        for (value, &wide) in values.iter_mut().zip(row) {
            *value = wide as f32;
        }
        push(&mut rows, &values, &mut sh, rest);
    })?;
    rows.finish(path)
}

/// Whether the layout is the compressed one.
pub(in crate::import) fn is_packed(path: &Path) -> Result<bool, DatasetError> {
    let packed = |element: &Element| {
        element.name == "chunk" || element.properties.iter().any(|p| p.name == "packed_position")
    };
    Ok(Ply::open(path)?.header.elements.iter().any(packed))
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

/// Takes a row of [`splat_properties`]. `sh` is scratch.
fn push(rows: &mut Rows, values: &[f32], sh: &mut Vec<f32>, rest: usize) {
    let (position, values) = values.split_at(3);
    let (dc, values) = values.split_at(3);
    let (bands, values) = values.split_at(rest);
    let &[opacity_logit, s0, s1, s2, w, x, y, z] = values else {
        unreachable!("a row of the layout ends with 8 values, not {}", values.len())
    };
    sh.clear();
    sh.extend_from_slice(dc);
    for k in 0..rest / 3 {
        sh.extend([0, 1, 2].map(|channel| bands[channel * (rest / 3) + k]));
    }
    rows.push(Row {
        mean: [position[0], position[1], position[2]],
        log_scale: [s0, s1, s2],
        quat: [w, x, y, z],
        opacity_logit,
        sh,
    });
}

fn column(path: &Path, vertices: &Element, name: &str) -> Result<usize, DatasetError> {
    let remedy = "a splat PLY needs x y z, f_dc_0..2, opacity, scale_0..2 and rot_0..3 \
                  (a point cloud is not a splat file)";
    vertices.find(&[name]).ok_or_else(|| missing(path, name, remedy))
}

fn sh_degree(path: &Path, vertices: &Element) -> Result<u8, DatasetError> {
    degree_of(vertices).map_err(|rest| {
        let problem = format!("there are {rest} of them, but degrees 0 to 3 have 0, 9, 24 or 45");
        malformed(path, "f_rest_*", problem)
    })
}

/// The degree for which an element has coefficients beyond band 0, or how many it has.
pub(super) fn degree_of(element: &Element) -> Result<u8, usize> {
    let rest = element.properties.iter().filter(|p| p.name.starts_with("f_rest_")).count();
    let fits = |degree: &u8| 3 * (sh_coefficients(*degree) - 1) == rest;
    (0..=MAX_SH_DEGREE).find(fits).ok_or(rest)
}
