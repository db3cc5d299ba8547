//! Where the nodes of a glTF document put their meshes.

use std::path::Path;

use glam::{DMat4, DQuat, DVec3};
use serde::Deserialize;

use crate::dataset::DatasetError;
use crate::import::model::malformed;
use crate::import::turn::Motion;

/// The half turn about z that leads from the frame of glTF to that of the other formats, and back.
pub(crate) const TURN: [f64; 4] = [0.0, 0.0, 1.0, 0.0];

/// A node of the scene.
#[derive(Deserialize)]
pub(super) struct Node {
    mesh: Option<usize>,
    #[serde(default)]
    children: Vec<usize>,
    matrix: Option<[f64; 16]>,
    rotation: Option<[f64; 4]>,
    translation: Option<[f64; 3]>,
    scale: Option<[f64; 3]>,
}

impl Node {
    fn matrix(&self) -> DMat4 {
        self.matrix.map_or_else(
            || {
                DMat4::from_scale_rotation_translation(
                    self.scale.map_or(DVec3::ONE, DVec3::from),
                    self.rotation.map_or(DQuat::IDENTITY, DQuat::from_array),
                    self.translation.map_or(DVec3::ZERO, DVec3::from),
                )
            },
            |columns| DMat4::from_cols_array(&columns),
        )
    }
}

/// The meshes that the roots show, all nodes where there are no roots, and how each is moved into the frame of the
/// other formats.
pub(super) fn placed(
    path: &Path,
    nodes: &[Node],
    roots: Option<&[usize]>,
) -> Result<Vec<(usize, Motion)>, DatasetError> {
    let wrong = |problem: &str| malformed(path, "nodes", problem);
    let home = DMat4::from_quat(DQuat::from_array(TURN));
    let every: Vec<usize> = (0..nodes.len()).collect();
    let mut open: Vec<(usize, DMat4)> =
        roots.unwrap_or(&every).iter().rev().map(|&node| (node, home)).collect();
    let (mut placed, mut seen) = (Vec::new(), vec![false; nodes.len()]);
    while let Some((index, parent)) = open.pop() {
        let node = nodes.get(index).ok_or_else(|| wrong("there is no such node"))?;
        if std::mem::replace(&mut seen[index], true) {
            return Err(wrong("two contain the same one, or they contain each other"));
        }
        let matrix = parent * node.matrix();
        if let Some(mesh) = node.mesh {
            let problem = "one is moved by other than a rotation, an even scale and a shift, which splats cannot follow";
            let motion = Motion::from_matrix(&matrix).ok_or_else(|| wrong(problem))?;
            placed.push((mesh, motion));
        }
        if roots.is_some() {
            open.extend(node.children.iter().rev().map(|&child| (child, matrix)));
        }
    }
    Ok(placed)
}
