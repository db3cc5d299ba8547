//! Positions of the meshes in a glTF scene.

use std::collections::BTreeMap;
use std::path::Path;

use glam::{DMat4, DQuat, DVec3};
use serde::Deserialize;
use serde::de::IgnoredAny;
use serde_json::Value;

use super::layout::HALF_TURN;
use crate::error::LoadError;
use crate::models::similarity::Similarity;

/// The extension that hides a node and all nodes below it.
pub(super) const VISIBILITY: &str = "KHR_node_visibility";
/// The extension that shows a node's mesh many times.
const INSTANCING: &str = "EXT_mesh_gpu_instancing";

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
    skin: Option<IgnoredAny>,
    #[serde(default)]
    extensions: BTreeMap<String, Value>,
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

    fn is_hidden(&self) -> bool {
        self.extensions.get(VISIBILITY).is_some_and(|extension| extension["visible"] == false)
    }
}

/// A mesh of the scene.
pub(super) struct Placed<'a> {
    /// Index of the mesh.
    pub(super) mesh: usize,
    /// True if its node, or one above it, is hidden.
    pub(super) is_hidden: bool,
    index: usize,
    node: &'a Node,
    /// Transform into the frame of the other formats.
    matrix: DMat4,
}

impl Placed<'_> {
    /// The transform of splats into the frame of the other formats.
    ///
    /// # Errors
    /// When the transform cannot be applied to splats, or the node changes them in another way than by a transform.
    pub(super) fn transform(&self, path: &Path) -> Result<Similarity, LoadError> {
        let Self { index, node, matrix, .. } = self;
        let wrong = |problem: &str| {
            let remedy = "place the splats without it, and export the file again";
            LoadError::malformed(path, format!("nodes[{index}]"), problem, remedy)
        };
        if node.extensions.contains_key(INSTANCING) {
            return Err(wrong(&format!("{INSTANCING} is not applied to splats")));
        }
        if node.skin.is_some() {
            return Err(wrong("a skin is not applied to splats"));
        }
        Similarity::from_matrix(matrix).ok_or_else(|| {
            wrong(if matrix.determinant() < 0.0 {
                "its transform, or that of a node above it, is a mirror image, which is not applied to splats"
            } else {
                "a transform contains shear or an uneven scale, which cannot be applied to splats"
            })
        })
    }
}

/// The meshes of a scene, whose nodes are below `roots`. If no scene is given, the roots are the nodes without a parent.
pub(super) fn placed_meshes<'a>(
    path: &Path,
    nodes: &'a [Node],
    roots: Option<&[usize]>,
) -> Result<Vec<Placed<'a>>, LoadError> {
    let wrong = |problem: &str| LoadError::damaged(path, "nodes", problem);
    let to_our_frame = DMat4::from_quat(DQuat::from_array(HALF_TURN));
    let mut is_root = vec![true; nodes.len()];
    for &child in nodes.iter().flat_map(|node| &node.children) {
        if let Some(mark) = is_root.get_mut(child) {
            *mark = false;
        }
    }
    let tops: Vec<usize> = (0..nodes.len()).filter(|&node| is_root[node]).collect();
    let mut stack: Vec<(usize, DMat4, bool)> =
        roots.unwrap_or(&tops).iter().rev().map(|&node| (node, to_our_frame, false)).collect();
    let (mut placed, mut seen) = (Vec::new(), vec![false; nodes.len()]);
    while let Some((index, parent, is_hidden)) = stack.pop() {
        let node = nodes.get(index).ok_or_else(|| wrong("there is no such node"))?;
        if std::mem::replace(&mut seen[index], true) {
            return Err(wrong("two nodes contain the same node, or nodes contain each other"));
        }
        let matrix = parent * node.matrix();
        let is_hidden = is_hidden || node.is_hidden();
        placed.extend(node.mesh.map(|mesh| Placed { mesh, is_hidden, index, node, matrix }));
        stack.extend(node.children.iter().rev().map(|&child| (child, matrix, is_hidden)));
    }
    Ok(placed)
}
