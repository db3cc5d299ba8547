//! Coloured point clouds, and their PLY files: x y z, and red green blue if present.

use std::path::Path;

use glam::DVec3;

use crate::error::LoadError;
use crate::ply::{Element, Ply, Scalar};

/// Colour of points that have none.
const GREY: u8 = 128;
/// Fractional colours up to this value are read on a scale of 0 to 1, even if some exceed 1: on a scale of 0 to 255,
/// all would be almost black.
const BRIGHTEST: f64 = 16.0;

/// A coloured point cloud in structure of arrays.
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

    /// At most `most` of the points, at equal intervals in their order.
    pub fn thinned(&self, most: usize) -> Self {
        let stride = self.len().div_ceil(most.max(1)).max(1);
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

/// Reads the vertices of a PLY file as points; other elements are skipped. Positions may be of any
/// type, and non-finite.
///
/// # Errors
/// When the file is unreadable, contradicts itself, or its vertices have no x, y, z.
pub fn read_points(path: &Path) -> Result<PointCloud, LoadError> {
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
    .map(|names| vertices.find(&names));
    let mut full = 1.0;
    if let [Some(r), Some(g), Some(b)] = channels {
        full = full_scale(path, &vertices, [r, g, b])?;
        columns.extend([r, g, b]);
    }
    let mut points = PointCloud::default();
    ply.each_row(&vertices, &columns, |row| {
        points.positions.push(DVec3::new(row[0], row[1], row[2]));
        points.colours.push(match row[3..] {
            // The cast turns NaN into 0 and saturates.
            [r, g, b] => [r, g, b].map(|v| (255.0 * (v / full) + 0.5) as u8),
            _ => [GREY; 3],
        });
    })?;
    Ok(points)
}

/// The value of a full colour channel: for bytes their largest value, otherwise the smallest usual value that no colour
/// exceeds, because programs write colours of 0 to 255 in any type.
///
/// # Errors
/// When floating-point colours exceed all usual values.
fn full_scale(path: &Path, vertices: &Element, channels: [usize; 3]) -> Result<f64, LoadError> {
    let kinds = channels.map(|column| vertices.properties[column].kind);
    if matches!(kinds, [Scalar::U8, Scalar::U8, Scalar::U8] | [Scalar::I8, Scalar::I8, Scalar::I8])
    {
        return Ok(kinds[0].largest());
    }
    let (mut most, mut is_whole) = (0.0_f64, true);
    Ply::open(path)?.each_row(vertices, &channels, |row| {
        for value in row.iter().filter(|value| value.is_finite()) {
            most = most.max(*value);
            is_whole &= value.fract() == 0.0;
        }
    })?;
    let largest = kinds.map(Scalar::largest).into_iter().fold(0.0, f64::max);
    let is_real = largest.is_infinite();
    let brightest = if is_whole { 1.0 } else { BRIGHTEST };
    let scales = [(is_real, brightest, 1.0), (true, 255.0, 255.0), (true, 65_535.0, 65_535.0)];
    let scale = scales.into_iter().find(|(applies, limit, _)| *applies && most <= *limit);
    match scale {
        Some((.., full)) => Ok(full),
        None if is_real => {
            let problem = format!("they reach {most}, which is no colour of 0 to 1, 255 or 65535");
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
            let points = read_points(&path).unwrap();
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
        assert_eq!(read_points(&path).unwrap().colours, [[0, 128, 255]]);
        std::fs::write(&path, text("1e6")).unwrap();
        let message = read_points(&path).unwrap_err().to_string();
        assert!(message.contains("file.ply: colours") && message.contains("1000000"), "{message}");
        let flat = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nend_header\n1 2";
        std::fs::write(&path, flat).unwrap();
        let message = read_points(&path).unwrap_err().to_string();
        assert!(message.contains("property z"), "{message}");
    }

    #[test]
    #[ignore = "needs shared data"]
    fn shared_colours_of_type_int_are_read() {
        let points = read_points(&densify_fixtures::shared("../cases/ply/int255.ply")).unwrap();
        assert_eq!(points.colours, [[200, 100, 50]; 4]);
    }

    #[test]
    #[ignore = "needs files of other programs: set DENSIFY_SHARED"]
    fn shared_clouds_of_other_programs_load() {
        for path in densify_fixtures::shared_files("points", "ply") {
            let points = read_points(&path).unwrap_or_else(|e| panic!("{e}"));
            assert!([8, 24].contains(&points.len()), "{}: {}", path.display(), points.len());
            let reach = points.positions.iter().map(|p| p.abs().max_element()).fold(0.0, f64::max);
            assert!((0.4..200.0).contains(&reach), "{}: {reach}", path.display());
        }
    }
}
