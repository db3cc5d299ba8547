//! Coloured point clouds, and their PLY files: x y z, and red green blue if present.

use std::path::Path;

use glam::DVec3;

use crate::error::LoadError;
use crate::models::PLY_OFFSET;
use crate::ply::{Element, Ply, Scalar};
use densify_core::files::one_line;
use densify_core::sh;

/// Colour of points that have none.
const GREY: u8 = 128;
/// Fractional colours up to this value are read on a scale of 0 to 1, even if some exceed 1: on a scale of 0 to 255,
/// all would be almost black.
const BRIGHTEST: f64 = 16.0;

/// A coloured point cloud as a structure of arrays.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PointCloud {
    /// Positions. Shape: `[points]`.
    pub positions: Vec<DVec3>,
    /// sRGB colours. Shape: `[points]`.
    pub colours: Vec<[u8; 3]>,
}

impl PointCloud {
    /// Number of points.
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// True if there is no point.
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }

    /// Bytes of all points.
    pub fn bytes(&self) -> u64 {
        (size_of_val(&self.positions[..]) + size_of_val(&self.colours[..])) as u64
    }

    /// At most `limit` of the points, at equal intervals in their order.
    pub fn thinned(&self, limit: usize) -> Self {
        let stride = self.len().div_ceil(limit.max(1)).max(1);
        Self {
            positions: self.positions.iter().copied().step_by(stride).collect(),
            colours: self.colours.iter().copied().step_by(stride).collect(),
        }
    }

    /// Drops the points whose positions fail `keep`; returns how many were dropped.
    pub(crate) fn retain(&mut self, keep: impl Fn(DVec3) -> bool) -> usize {
        let before = self.positions.len();
        let mut kept = self.positions.iter().map(|&p| keep(p));
        self.colours.retain(|_| kept.next().unwrap_or(false));
        self.positions.retain(|&p| keep(p));
        before - self.positions.len()
    }
}

/// Reads the vertices of a PLY file as points; also returns a note if they have no colours, or are Gaussians. Other
/// elements are skipped. Positions may be of any type and may be non-finite. The Gaussians of a splat model are read as
/// points, in world coordinates even if the file has local ones.
///
/// # Errors
/// When the file is unreadable, contradicts itself, or its vertices have no x, y, z.
pub fn read_points(path: &Path) -> Result<(PointCloud, Option<String>), LoadError> {
    let mut ply = Ply::open(path)?;
    let vertices = ply.element("vertex")?;
    let mut columns = Vec::new();
    for axis in ["x", "y", "z"] {
        columns.push(vertices.column(path, axis, "a point cloud needs x, y and z")?);
    }
    let channels: [Option<usize>; 3] = [
        ["red", "diffuse_red", "r"],
        ["green", "diffuse_green", "g"],
        ["blue", "diffuse_blue", "b"],
    ]
    .map(|names| vertices.find_in_any_case(&names));
    let coefficients = ["f_dc_0", "f_dc_1", "f_dc_2"].map(|name| vertices.find(&[name]));
    // A colour from 0 to 1 is `offset + factor · value / full`.
    let (mut offset, mut factor, mut full) = (0.0, 1.0, 1.0);
    if let [Some(r), Some(g), Some(b)] = channels {
        full = full_scale(path, &vertices, [r, g, b])?;
        columns.extend([r, g, b]);
    } else if let [Some(r), Some(g), Some(b)] = coefficients {
        (offset, factor) = (0.5, f64::from(sh::C0));
        columns.extend([r, g, b]);
    }
    let origin = ply.comment_numbers(PLY_OFFSET)?.map(DVec3::from);
    let mut points = PointCloud::default();
    ply.each_row(&vertices, &columns, |row| {
        let position = DVec3::new(row[0], row[1], row[2]);
        points.positions.push(origin.map_or(position, |origin| position + origin));
        points.colours.push(match row[3..] {
            // The cast turns NaN into 0 and saturates.
            [r, g, b] => [r, g, b].map(|v| (255.0 * (offset + factor * (v / full)) + 0.5) as u8),
            _ => [GREY; 3],
        });
    })?;
    let file = path.file_name().unwrap_or_default().to_string_lossy();
    let note = if points.is_empty() {
        None
    } else if columns.len() == 3 {
        Some("the points have no colours; they start grey")
    } else if vertices.find(&["opacity"]).is_some() && vertices.find(&["scale_0"]).is_some() {
        Some(
            "this is a splat model, of which only positions and colours are used, as initial points; to continue its \
             training, start from the model instead",
        )
    } else {
        None
    };
    let note = note.map(|note| one_line(&format!("{file}: {note}")));
    Ok((points, note))
}

/// The value of a full colour channel: for bytes, the largest value of their type; otherwise, the smallest usual value
/// that no colour exceeds, because programs write colours of 0 to 255 in any type.
///
/// # Errors
/// When floating-point colours exceed all usual values.
fn full_scale(path: &Path, vertices: &Element, channels: [usize; 3]) -> Result<f64, LoadError> {
    let kinds = channels.map(|column| vertices.properties[column].kind);
    if matches!(kinds, [Scalar::U8, Scalar::U8, Scalar::U8] | [Scalar::I8, Scalar::I8, Scalar::I8])
    {
        return Ok(kinds[0].largest());
    }
    let (mut max_value, mut is_whole) = (0.0_f64, true);
    Ply::open(path)?.each_row(vertices, &channels, |row| {
        for value in row.iter().filter(|value| value.is_finite()) {
            max_value = max_value.max(*value);
            is_whole &= value.fract() == 0.0;
        }
    })?;
    let largest = kinds.map(Scalar::largest).into_iter().fold(0.0, f64::max);
    let is_real = largest.is_infinite();
    let brightest = if is_whole { 1.0 } else { BRIGHTEST };
    let scales = [(is_real, brightest, 1.0), (true, 255.0, 255.0), (true, 65_535.0, 65_535.0)];
    let scale = scales.into_iter().find(|(applies, limit, _)| *applies && max_value <= *limit);
    match scale {
        Some((.., full)) => Ok(full),
        None if is_real => {
            let problem =
                format!("they reach {max_value}, but colours must be from 0 to 1, 255 or 65535");
            Err(LoadError::damaged(path, "colours of the vertices", problem))
        }
        None => Ok(largest),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_of_any_type_are_scaled() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("file.ply");
        for (kind, colour, expected) in [
            ("uchar", "0 128 255", [0, 128, 255]),
            ("ushort", "0 32896 65535", [0, 128, 255]),
            ("float", "0 0.5 1", [0, 128, 255]),
            ("double", "-1 nan 1.5", [0, 0, 255]),
            ("float", "3.7 0.5 0.25", [255, 128, 64]),
            ("double", "-1 nan 7", [0, 0, 7]),
            ("int", "200 100 50", [200, 100, 50]),
            ("uint32", "0 128 255", [0, 128, 255]),
            ("short", "-1 3 255", [0, 3, 255]),
            ("ushort", "200 100 50", [200, 100, 50]),
            ("float", "200 100 50", [200, 100, 50]),
            ("float64", "0 127.6 3", [0, 128, 3]),
            ("uint", "0 32896 65535", [0, 128, 255]),
            ("float", "0 32896 65535", [0, 128, 255]),
            ("int", "0 1073741824 2147483647", [0, 128, 255]),
            ("char", "0 64 127", [0, 129, 255]),
        ] {
            let text = format!(
                "ply\nformat ascii 1.0\nelement vertex 1\nproperty {kind} red\nproperty {kind} green\nproperty {kind} blue\n\
                 property short x\nproperty double y\nproperty float z\nend_header\n{colour} 1 2 3\n"
            );
            std::fs::write(&path, text).unwrap();
            let (points, note) = read_points(&path).unwrap();
            assert_eq!(note, None, "{kind}");
            assert_eq!(points.positions, [DVec3::new(1.0, 2.0, 3.0)], "{kind}");
            assert_eq!(points.colours, [expected], "{kind}");
        }
        let text = |blue| {
            format!(
                "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n\
                 property float r\nproperty float g\nproperty float b\nend_header\n1 2 3 0 0.5 {blue}\n"
            )
        };
        std::fs::write(&path, text("inf")).unwrap();
        assert_eq!(read_points(&path).unwrap().0.colours, [[0, 128, 255]]);
        std::fs::write(&path, text("1e6")).unwrap();
        let message = read_points(&path).unwrap_err().to_string();
        assert!(message.contains("file.ply: colours") && message.contains("1000000"), "{message}");
        let flat = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nend_header\n1 2";
        std::fs::write(&path, flat).unwrap();
        let message = read_points(&path).unwrap_err().to_string();
        assert!(message.contains("property z"), "{message}");
    }

    /// Models of Gaussian splats hold SH coefficients of colours; 0 is mid-grey.
    #[test]
    fn colours_of_other_names_are_read_and_missing_ones_are_noted() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("file.ply");
        for (names, colour, expected) in [
            (["Red", "Green", "Blue"], "0 0.5 1", Some([0, 128, 255])),
            (["DIFFUSE_RED", "DIFFUSE_GREEN", "DIFFUSE_BLUE"], "1 0 0", Some([255, 0, 0])),
            (["f_dc_0", "f_dc_1", "f_dc_2"], "0 -1.7724539 9", Some([128, 0, 255])),
            (["nx", "ny", "nz"], "0 0 1", None),
        ] {
            let columns = names.map(|name| format!("property float {name}\n")).concat();
            let text = format!(
                "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n\
                 {columns}end_header\n1 2 3 {colour}\n"
            );
            std::fs::write(&path, text).unwrap();
            let (points, note) = read_points(&path).unwrap();
            assert_eq!(points.colours, [expected.unwrap_or([GREY; 3])], "{names:?}");
            let is_noted = note.is_some_and(|note| note.contains("file.ply: the points have no"));
            assert_eq!(is_noted, expected.is_none(), "{names:?}");
        }
    }

    /// Models in local coordinates state an offset.
    #[test]
    fn an_offset_in_the_header_is_added_to_positions() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("file.ply");
        let text = "ply\nformat ascii 1.0\ncomment densify offset 500000.5 -4 1e6\nelement vertex 1\n\
                    property float x\nproperty float y\nproperty float z\nend_header\n1 2 3\n";
        std::fs::write(&path, text).unwrap();
        let (points, _) = read_points(&path).unwrap();
        assert_eq!(points.positions, [DVec3::new(500_001.5, -2.0, 1_000_003.0)]);
    }

    #[test]
    #[ignore = "needs shared data"]
    fn shared_colours_of_type_int_are_read() {
        let (points, _) =
            read_points(&densify_fixtures::shared("../cases/ply/int255.ply")).unwrap();
        assert_eq!(points.colours, [[200, 100, 50]; 4]);
    }

    #[test]
    #[ignore = "needs files of other programs: set DENSIFY_SHARED"]
    fn shared_clouds_of_other_programs_load() {
        for path in densify_fixtures::shared_files("points", "ply") {
            let (points, _) = read_points(&path).unwrap_or_else(|e| panic!("{e}"));
            assert!([8, 24].contains(&points.len()), "{}: {}", path.display(), points.len());
            let reach = points.positions.iter().map(|p| p.abs().max_element()).fold(0.0, f64::max);
            assert!((0.4..200.0).contains(&reach), "{}: {reach}", path.display());
        }
    }
}
