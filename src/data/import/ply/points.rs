//! Reads point clouds: x y z, and red green blue if present.

use std::path::Path;

use glam::DVec3;

use super::missing;
use super::rows::Ply;
use crate::dataset::DatasetError;
use crate::import::PointCloud;

/// Colour of points that have none.
const GREY: u8 = 128;

/// Reads the vertices of a PLY file as points; other elements are skipped. Positions may be of any
/// type, and non-finite.
///
/// # Errors
/// When the file is unreadable, contradicts itself, or its vertices have no x, y, z.
pub fn read_points(path: &Path) -> Result<PointCloud, DatasetError> {
    let mut ply = Ply::open(path)?;
    let vertices = ply.element("vertex")?;
    let mut columns = Vec::new();
    for axis in ["x", "y", "z"] {
        let missing = || missing(path, axis, "a point cloud needs x, y and z");
        columns.push(vertices.find(&[axis]).ok_or_else(missing)?);
    }
    let channels: [Option<usize>; 3] = [
        ["red", "diffuse_red", "r"],
        ["green", "diffuse_green", "g"],
        ["blue", "diffuse_blue", "b"],
    ]
    .map(|names| vertices.find(&names));
    let mut full = [1.0; 3];
    if let [Some(r), Some(g), Some(b)] = channels {
        full = [r, g, b].map(|column| vertices.properties[column].kind.full());
        columns.extend([r, g, b]);
    }
    let mut points = PointCloud::default();
    ply.each_row(&vertices, &columns, |row| {
        points.positions.push(DVec3::new(row[0], row[1], row[2]));
        points.colours.push(match row[3..] {
            // The cast takes NaN to 0 and saturates.
            [r, g, b] => [r / full[0], g / full[1], b / full[2]].map(|v| (255.0 * v + 0.5) as u8),
            _ => [GREY; 3],
        });
    })?;
    Ok(points)
}
