//! Builds the bounding volume hierarchy of a mesh in parts, as the builder of the library (obvhs) needs three times the
//! memory of its result.
//!
//! The triangles are repeatedly split in halves at the median along the widest axis. The trees of the parts are
//! attached to the nodes of these splits, and the library's optimiser then improves the whole tree.

use obvhs::aabb::Aabb;
use obvhs::bvh2::Bvh2;
use obvhs::bvh2::leaf_collapser::collapse;
use obvhs::bvh2::node::Bvh2Node;
use obvhs::bvh2::reinsertion::ReinsertionOptimizer;
use obvhs::ploc::{PlocBuilder, PlocSearchDistance, SortPrecision};

/// Maximum number of triangles of a part. The builder takes about 200 bytes for each.
const PART: usize = 1 << 16;
/// Share of the nodes that the first round of the last optimisation tries to move: those with the largest boxes.
const IMPROVED: f32 = 0.1;

/// Builds the tree over `count` triangles with boxes `box_of`. Leaves hold up to eight triangles;
/// `primitive_indices` lists the triangles in the order of the leaves.
pub(crate) fn build(count: usize, box_of: impl Fn(u32) -> Aabb) -> Bvh2 {
    build_in_parts(count, PART, &box_of)
}

fn build_in_parts(count: usize, part: usize, box_of: &impl Fn(u32) -> Aabb) -> Bvh2 {
    let mut ids: Vec<u32> = (0..count as u32).collect();
    let mut tree = Bvh2::default();
    tree.nodes.push(Bvh2Node::default());
    tree.primitive_indices.reserve_exact(count);
    build_below(&mut tree, 0, &mut ids, part, box_of);
    drop(ids);
    // The optimiser sizes its stacks by the depth.
    tree.max_depth = tree.max_depth.max(depth(&tree));
    improve(&mut tree);
    // Only the optimiser needs parents.
    tree.parents = Vec::new();
    tree
}

/// Builds the tree over `ids` below an existing node.
fn build_below(
    tree: &mut Bvh2,
    place: usize,
    ids: &mut [u32],
    part: usize,
    box_of: &impl Fn(u32) -> Aabb,
) {
    if ids.len() <= part {
        graft(tree, place, &build_part(ids, box_of), ids);
        return;
    }
    let mut centres = Aabb::empty();
    for &id in &*ids {
        centres.extend(box_of(id).center());
    }
    let size = centres.diagonal();
    let axis = (0..3).fold(0, |widest, axis| if size[axis] > size[widest] { axis } else { widest });
    let along = |id: u32| box_of(id).center()[axis];
    let half = ids.len() / 2;
    ids.select_nth_unstable_by(half, |&a, &b| along(a).total_cmp(&along(b)).then(a.cmp(&b)));
    let (left, right) = ids.split_at_mut(half);
    let pair = tree.nodes.len();
    tree.nodes.extend([Bvh2Node::default(); 2]);
    build_below(tree, pair, left, part, box_of);
    build_below(tree, pair + 1, right, part, box_of);
    let around = tree.nodes[pair].aabb().union(tree.nodes[pair + 1].aabb());
    tree.nodes[place] = Bvh2Node::new(around, 0, pair as u32);
}

/// Adds the tree of a part to the whole tree, with its root at `place`.
fn graft(tree: &mut Bvh2, place: usize, part: &Bvh2, ids: &[u32]) {
    // The part's root replaces the existing node `place`; each other node i is appended as node i + `nodes`.
    let (nodes, primitives) = (tree.nodes.len() - 1, tree.primitive_indices.len());
    let mut moved = part.nodes.iter().map(|node| {
        let shift = if node.is_leaf() { primitives } else { nodes };
        Bvh2Node::new(*node.aabb(), node.prim_count, node.first_index + shift as u32)
    });
    if let Some(root) = moved.next() {
        tree.nodes[place] = root;
    }
    tree.nodes.reserve_exact(moved.len());
    tree.nodes.extend(moved);
    tree.primitive_indices.extend(part.primitive_indices.iter().map(|&i| ids[i as usize]));
    tree.max_depth = tree.max_depth.max(part.max_depth);
}

/// Builds the tree of a part like the library's medium preset, but without its last optimisation. The steps are called
/// one by one, as the library's own function validates the tree in debug builds and panics if a hostile mesh makes it
/// degenerate. Triangles are numbered by their indices in `ids`.
fn build_part(ids: &[u32], box_of: &impl Fn(u32) -> Aabb) -> Bvh2 {
    let boxes: Vec<Aabb> = ids.iter().map(|&id| box_of(id)).collect();
    let mut part = PlocBuilder::with_capacity(boxes.len()).build(
        PlocSearchDistance::Medium,
        &boxes,
        (0..boxes.len() as u32).collect(),
        SortPrecision::U64,
        3,
    );
    drop(boxes);
    ReinsertionOptimizer::default().run(&mut part, 0.05, None);
    collapse(&mut part, 8, 3.0);
    part
}

/// Runs the optimiser's schedule on the nodes with the largest boxes, wherever they are stored; the optimiser's
/// own function looks for them among the first nodes only.
fn improve(tree: &mut Bvh2) {
    let mut optimiser = ReinsertionOptimizer::default();
    let mut largest: Vec<(f32, u32)> = Vec::new();
    for divisor in (1..32).step_by(2) {
        let count = (tree.nodes.len() as f32 * IMPROVED / divisor as f32) as usize;
        if count == 0 {
            break;
        }
        let nodes = tree.nodes.iter().enumerate().skip(1);
        largest.clear();
        largest.extend(nodes.map(|(i, node)| (node.aabb().half_area(), i as u32)));
        let order = |a: &(f32, u32), b: &(f32, u32)| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1));
        if count < largest.len() {
            largest.select_nth_unstable_by(count, order);
            largest.truncate(count);
        }
        let candidates: Vec<u32> = largest.iter().map(|&(_, node)| node).collect();
        optimiser.run_with_candidates(tree, &candidates, 1);
    }
}

/// Number of levels of the tree. The library's own bound holds only before optimisation, and its traversal stacks
/// panic when full.
pub(crate) fn depth(bvh: &Bvh2) -> usize {
    let mut deepest = 1;
    let mut open = vec![(0_u32, 1_usize)];
    while let Some((index, level)) = open.pop() {
        deepest = deepest.max(level);
        if let Some(node) = bvh.nodes.get(index as usize)
            && !node.is_leaf()
        {
            open.extend([(node.first_index, level + 1), (node.first_index + 1, level + 1)]);
        }
    }
    deepest
}

#[cfg(test)]
mod tests {
    use glam::Vec3A;

    use super::*;

    /// Boxes on a curve, some of which coincide.
    fn box_of(id: u32) -> Aabb {
        let along = (id / 3) as f32;
        let at = Vec3A::new(along, (0.1 * along).sin(), 0.01 * along * along);
        Aabb::new(at - 0.4, at + 0.4)
    }

    /// Checks that every triangle is in one leaf, and that every box contains those below it.
    fn check(tree: &Bvh2, count: u32) {
        let mut seen = vec![false; count as usize];
        let mut open = vec![0_u32];
        while let Some(index) = open.pop() {
            let node = &tree.nodes[index as usize];
            let holds = |inner: &Aabb| {
                assert!(inner.min.cmpge(node.aabb().min).all());
                assert!(inner.max.cmple(node.aabb().max).all());
            };
            if !node.is_leaf() {
                for child in [node.first_index, node.first_index + 1] {
                    holds(tree.nodes[child as usize].aabb());
                    open.push(child);
                }
                continue;
            }
            for slot in node.first_index..node.first_index + node.prim_count {
                let id = tree.primitive_indices[slot as usize];
                holds(&box_of(id));
                assert!(!std::mem::replace(&mut seen[id as usize], true), "{id} twice");
            }
        }
        assert!(seen.iter().all(|&seen| seen));
    }

    #[test]
    fn parts_make_one_tree() {
        for count in [1, 2, 7, 8, 9, 100, 1000] {
            for part in [1, 3, 64, 1000] {
                let tree = build_in_parts(count as usize, part, &box_of);
                check(&tree, count);
                assert_eq!(tree.primitive_indices.len(), count as usize);
            }
        }
    }

    #[test]
    fn a_tree_built_in_parts_costs_little_more_to_traverse() {
        // The expected number of boxes hit by a ray that hits the root's box, by their areas.
        let cost = |tree: &Bvh2| {
            let areas: f32 = tree.nodes.iter().map(|node| node.aabb().half_area()).sum();
            areas / tree.nodes[0].aabb().half_area()
        };
        let (whole, parts) =
            (build_in_parts(5000, 5000, &box_of), build_in_parts(5000, 500, &box_of));
        assert!(cost(&parts) < 1.05 * cost(&whole), "{} {}", cost(&parts), cost(&whole));
    }
}
