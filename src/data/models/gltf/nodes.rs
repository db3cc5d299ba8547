//! Transforms of the meshes in a glTF scene.

use std::path::Path;

use glam::{DMat4, DQuat, DVec3};
use serde::Deserialize;

use super::layout::HALF_TURN;
use crate::error::LoadError;
use crate::models::similarity::Similarity;

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
        match &self.matrix {
            Some(columns) => DMat4::from_cols_array(columns),
            None => DMat4::from_scale_rotation_translation(
                self.scale.map_or(DVec3::ONE, DVec3::from),
                self.rotation.map_or(DQuat::IDENTITY, DQuat::from_array),
                self.translation.map_or(DVec3::ZERO, DVec3::from),
            ),
        }
    }
}

/// The meshes below the roots, or of all nodes if no roots are given, each with its transform into the frame of the
/// other formats.
pub(super) fn placed_meshes(
    path: &Path,
    nodes: &[Node],
    roots: Option<&[usize]>,
) -> Result<Vec<(usize, Similarity)>, LoadError> {
    let wrong = |problem: &str| LoadError::damaged(path, "nodes", problem);
    let to_our_frame = DMat4::from_quat(DQuat::from_array(HALF_TURN));
    let every: Vec<usize> = (0..nodes.len()).collect();
    let mut stack: Vec<(usize, DMat4)> =
        roots.unwrap_or(&every).iter().rev().map(|&node| (node, to_our_frame)).collect();
    let (mut placed, mut seen) = (Vec::new(), vec![false; nodes.len()]);
    while let Some((index, parent)) = stack.pop() {
        let node = nodes.get(index).ok_or_else(|| wrong("there is no such node"))?;
        if std::mem::replace(&mut seen[index], true) {
            return Err(wrong("two nodes contain the same node, or nodes contain each other"));
        }
        let matrix = parent * node.matrix();
        if let Some(mesh) = node.mesh {
            let problem =
                "a transform contains shear or an uneven scale, which cannot be applied to splats";
            let transform = Similarity::from_matrix(&matrix).ok_or_else(|| wrong(problem))?;
            placed.push((mesh, transform));
        }
        if roots.is_some() {
            stack.extend(node.children.iter().rev().map(|&child| (child, matrix)));
        }
    }
    Ok(placed)
}
