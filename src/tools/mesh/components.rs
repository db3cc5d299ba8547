//! Drops the small connected parts of a mesh, most of which floaters caused.

use glam::Vec3;

use super::mesh::Mesh;

/// Drops the components with less than this fraction of the mesh's area, and all vertices without triangles. Returns
/// the number of the dropped components and their fraction of the area.
pub(super) fn drop_small(mesh: &mut Mesh, min_component: f64) -> (usize, f64) {
    let mut parents: Vec<u32> = (0..mesh.positions.len() as u32).collect();
    for &[a, b, c] in &mesh.triangles {
        join(&mut parents, a, b);
        join(&mut parents, a, c);
    }
    // The area of a component is stored at its root; other vertices have 0.
    let mut areas = vec![0.0_f64; parents.len()];
    for triangle in &mesh.triangles {
        areas[root(&mut parents, triangle[0]) as usize] +=
            area(triangle.map(|i| mesh.positions[i as usize]));
    }
    let total: f64 = areas.iter().sum();
    let limit = min_component * total;
    // A component with triangles that have no area is small, too.
    let (mut count, mut dropped) = (0, 0.0);
    let mut is_root = vec![false; parents.len()];
    for triangle in &mesh.triangles {
        is_root[root(&mut parents, triangle[0]) as usize] = true;
    }
    for (area, _) in
        areas.iter().zip(&is_root).filter(|(area, is_root)| **is_root && **area < limit)
    {
        (count, dropped) = (count + 1, dropped + area);
    }
    mesh.triangles.retain(|triangle| areas[root(&mut parents, triangle[0]) as usize] >= limit);
    drop_unused(mesh);
    (count, if total > 0.0 { dropped / total } else { 0.0 })
}

/// Drops vertices without triangles; the others keep their order.
fn drop_unused(mesh: &mut Mesh) {
    let mut places = vec![u32::MAX; mesh.positions.len()];
    for &vertex in mesh.triangles.as_flattened() {
        places[vertex as usize] = 0;
    }
    let mut kept = 0;
    for (vertex, place) in places.iter_mut().enumerate() {
        if *place == 0 {
            *place = kept;
            mesh.positions[kept as usize] = mesh.positions[vertex];
            kept += 1;
        }
    }
    mesh.positions.truncate(kept as usize);
    for vertex in mesh.triangles.as_flattened_mut() {
        *vertex = places[*vertex as usize];
    }
}

fn root(parents: &mut [u32], mut vertex: u32) -> u32 {
    while parents[vertex as usize] != vertex {
        // Halves the path.
        parents[vertex as usize] = parents[parents[vertex as usize] as usize];
        vertex = parents[vertex as usize];
    }
    vertex
}

/// Joins two components; the lower root stays.
fn join(parents: &mut [u32], a: u32, b: u32) {
    let (a, b) = (root(parents, a), root(parents, b));
    parents[a.max(b) as usize] = a.min(b);
}

fn area(corners: [[f32; 3]; 3]) -> f64 {
    let [a, b, c] = corners.map(|corner| Vec3::from(corner).as_dvec3());
    0.5 * (b - a).cross(c - a).length()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[allow(clippy::float_cmp, reason = "exact values")]
    fn small_components_and_unused_vertices_go() {
        let square = |x: f32, side: f32| {
            [[x, 0.0, 0.0], [x + side, 0.0, 0.0], [x + side, side, 0.0], [x, side, 0.0]]
        };
        // An unused vertex, a square of area 1, one of area 9, joined by a fold.
        let mut positions = vec![[9.0; 3]];
        positions.extend(square(0.0, 1.0));
        positions.extend(square(5.0, 3.0));
        let triangles = vec![[1, 2, 3], [1, 3, 4], [5, 6, 7], [7, 8, 5]];
        let mut mesh = Mesh::new(positions.clone(), triangles.clone());
        assert_eq!(drop_small(&mut mesh, 0.11), (1, 0.1));
        assert_eq!(mesh.positions, square(5.0, 3.0));
        assert_eq!(mesh.triangles, [[0, 1, 2], [2, 3, 0]]);
        let mut mesh = Mesh::new(positions, triangles);
        assert_eq!(drop_small(&mut mesh, 0.09), (0, 0.0));
        assert_eq!((mesh.positions.len(), mesh.triangles.len()), (8, 4));
    }
}
