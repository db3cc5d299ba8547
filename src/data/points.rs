//! Coloured point clouds, and their PLY files: x y z, and red green blue if present.

use std::path::Path;

use glam::DVec3;

use crate::error::LoadError;
use crate::ply::Ply;

/// Colour of points that have none.
const GREY: u8 = 128;

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
    let mut full = [1.0; 3];
    if let [Some(r), Some(g), Some(b)] = channels {
        full = [r, g, b].map(|column| vertices.properties[column].kind.full_scale());
        columns.extend([r, g, b]);
    }
    let mut points = PointCloud::default();
    ply.each_row(&vertices, &columns, |row| {
        points.positions.push(DVec3::new(row[0], row[1], row[2]));
        points.colours.push(match row[3..] {
            // The cast turns NaN into 0 and saturates.
            [r, g, b] => [r / full[0], g / full[1], b / full[2]].map(|v| (255.0 * v + 0.5) as u8),
            _ => [GREY; 3],
        });
    })?;
    Ok(points)
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
            ("double", "-1 nan 7", [0, 0, 255]),
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
        let flat = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nend_header\n1 2";
        std::fs::write(&path, flat).unwrap();
        let message = read_points(&path).unwrap_err().to_string();
        assert!(message.contains("property z"), "{message}");
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
