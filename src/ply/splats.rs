//! Splats in the layout of the original 3DGS trainer (Kerbl et al. 2023, `save_ply`):
//! x y z, nx ny nz (zero), f_dc_0..2, f_rest_* channel by channel, opacity (logit),
//! scale_0..2 (logarithms), rot_0..3 (w x y z); all f32.

use std::io::{self, Write};
use std::path::Path;

use super::PlyError;
use super::header::Element;
use super::rows::Ply;
use crate::gaussians::{Gaussians, MAX_SH_DEGREE, sh_coefficients};

/// Share of rows that may be unusable.
const MAX_BAD_ROWS: f64 = 0.01;
/// Squared length below which a quaternion has no direction left: 1e-6 of its unit.
const NO_ROTATION: f32 = 1e-12;
/// Rows per write.
const CHUNK: usize = 256;

/// What a splat file holds.
#[derive(Debug, Clone, PartialEq)]
pub struct SplatFile {
    /// The rows, in the file's order and coordinates, bit for bit.
    pub gaussians: Gaussians,
    /// Rows left out because a value was not finite.
    pub dropped: usize,
    /// Rows whose quaternion was zero and is the identity now.
    pub repaired: usize,
}

/// Reads a splat PLY by any program that keeps the original property names.
///
/// # Errors
/// When the file is unreadable or contradicts itself, a property is missing, the layout is the
/// compressed one, or more than 1 % of the rows are not finite.
pub fn read_splats(path: &Path) -> Result<SplatFile, PlyError> {
    let mut ply = Ply::open(path)?;
    let packed = |element: &Element| {
        element.name == "chunk" || element.properties.iter().any(|p| p.name == "packed_position")
    };
    if ply.header.elements.iter().any(packed) {
        return Err(PlyError::Compressed { path: path.to_owned() });
    }
    let vertices = ply.element("vertex")?;
    let sh_degree = degree(path, &vertices)?;
    let rest = 3 * (sh_coefficients(sh_degree) - 1);
    let columns =
        layout(rest).map(|name| column(path, &vertices, &name)).collect::<Result<Vec<_>, _>>()?;

    let mut gaussians = Gaussians { sh_degree, ..Gaussians::default() };
    let (mut total, mut dropped, mut repaired) = (0, 0, 0);
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
        return Err(PlyError::NotFinite { path: path.to_owned(), bad: dropped, total });
    }
    Ok(SplatFile { gaussians, dropped, repaired })
}

/// The properties that carry a row, without the normals, in the order of [`push`].
fn layout(rest: usize) -> impl Iterator<Item = String> {
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

/// Appends a row of [`layout`]; says whether the quaternion had to be replaced.
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
    let lost = w * w + x * x + y * y + z * z < NO_ROTATION;
    gaussians.quats.push(if lost { [1.0, 0.0, 0.0, 0.0] } else { [w, x, y, z] });
    lost
}

fn column(path: &Path, vertices: &Element, name: &str) -> Result<usize, PlyError> {
    vertices.find(&[name]).ok_or_else(|| PlyError::Missing {
        path: path.to_owned(),
        property: name.to_owned(),
        remedy: "a splat PLY needs x y z, f_dc_0..2, opacity, scale_0..2 and rot_0..3 \
                 (a point cloud is no splat file)",
    })
}

fn degree(path: &Path, vertices: &Element) -> Result<u8, PlyError> {
    let rest = vertices.properties.iter().filter(|p| p.name.starts_with("f_rest_")).count();
    let fits = |degree: &u8| 3 * (sh_coefficients(*degree) - 1) == rest;
    (0..=MAX_SH_DEGREE).find(fits).ok_or_else(|| {
        let problem = format!("there are {rest} of them, but degrees 0 to 3 have 0, 9, 24 or 45");
        PlyError::malformed(path, "f_rest_*", problem)
    })
}

/// Writes a splat PLY, binary little endian. Values go out bit for bit.
///
/// # Errors
/// What `out` says.
pub fn write_splats(model: &Gaussians, out: &mut impl Write) -> io::Result<()> {
    write_splat_header(model.len(), model.sh_degree, out)?;
    write_splat_rows(model, out)
}

/// Writes what comes before the rows in a splat PLY of so many rows of a degree.
///
/// # Errors
/// What `out` says.
pub fn write_splat_header(rows: usize, sh_degree: u8, out: &mut impl Write) -> io::Result<()> {
    let coefficients = sh_coefficients(sh_degree);
    let mut header = format!("ply\nformat binary_little_endian 1.0\nelement vertex {rows}\n");
    for (index, name) in layout(3 * (coefficients - 1)).enumerate() {
        if index == 3 {
            for normal in ["nx", "ny", "nz"] {
                header += &format!("property float {normal}\n");
            }
        }
        header += &format!("property float {name}\n");
    }
    header += "end_header\n";
    out.write_all(header.as_bytes())
}

/// Writes some rows of the model whose [header](write_splat_header) has been written.
///
/// # Errors
/// What `out` says.
pub fn write_splat_rows(model: &Gaussians, out: &mut impl Write) -> io::Result<()> {
    let coefficients = sh_coefficients(model.sh_degree);
    let mut chunk = Vec::with_capacity(CHUNK * 4 * (14 + 3 * coefficients));
    for row in 0..model.len() {
        let mut put = |value: f32| chunk.extend_from_slice(&value.to_le_bytes());
        let sh = model.sh_of(row);
        model.means[row].into_iter().for_each(&mut put);
        [0.0; 3].into_iter().for_each(&mut put);
        sh[..3].iter().copied().for_each(&mut put);
        for channel in 0..3 {
            sh[3..].iter().skip(channel).step_by(3).copied().for_each(&mut put);
        }
        put(model.opacity_logits[row]);
        model.log_scales[row].into_iter().for_each(&mut put);
        model.quats[row].into_iter().for_each(&mut put);
        if row % CHUNK == CHUNK - 1 {
            out.write_all(&chunk)?;
            chunk.clear();
        }
    }
    out.write_all(&chunk)
}
