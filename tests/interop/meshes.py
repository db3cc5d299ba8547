"""Reads meshes of `densify mesh` with trimesh, as other programs would.

    python meshes.py MESH.ply MESH.glb MESH.obj     the same mesh in three formats
"""

import sys
from pathlib import Path

import numpy as np
import trimesh


def encoded(linear: np.ndarray) -> np.ndarray:
    """sRGB-encodes linear values (IEC 61966-2-1)."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def read(path: Path) -> tuple[trimesh.Trimesh, np.ndarray]:
    """The mesh in the coordinates of the file, and its colours, sRGB-encoded, from 0 to 255."""
    scene = trimesh.load_scene(path, process=False)
    assert len(scene.geometry) == 1, f"{path}: {len(scene.geometry)} meshes"
    mesh = scene.to_mesh()
    if path.suffix != ".glb":
        return mesh, mesh.visual.vertex_colors[:, :3].astype(float)
    # Beside a material, trimesh keeps colours as an attribute of the geometry. Those of glTF are linear.
    (geometry,) = scene.geometry.values()
    colours = geometry.visual.vertex_attributes["color"]
    return mesh, 255 * encoded(colours[:, :3] / np.iinfo(colours.dtype).max)


def check(path: Path) -> tuple[trimesh.Trimesh, np.ndarray]:
    mesh, colours = read(path)
    print(f"{path.name}: {len(mesh.vertices)} vertices, {len(mesh.faces)} faces, watertight: {mesh.is_watertight}")
    assert len(mesh.faces) > 100 and len(colours) == len(mesh.vertices), path
    assert np.isfinite(mesh.vertices).all() and (mesh.area_faces >= 0).all(), path
    # Each vertex is used, and no triangle occurs twice.
    assert len(np.unique(mesh.faces)) == len(mesh.vertices), f"{path}: unused vertices"
    assert len(np.unique(np.sort(mesh.faces, axis=1), axis=0)) == len(mesh.faces), f"{path}: triangles occur twice"
    # Neighbours agree on what is outside, except for a few at borders where two surfaces share an edge.
    pairs = trimesh.grouping.group_rows(mesh.edges_sorted, require_count=2)
    same = (mesh.edges[pairs[:, 0]] == mesh.edges[pairs[:, 1]]).all(axis=1)
    print(f"    {same.sum()} of {len(same)} pairs of neighbours face opposite sides")
    assert same.mean() < 1e-3, f"{path}: neighbouring triangles face opposite sides"
    assert colours.std() > 5, f"{path}: the colours are uniform"
    # Each edge that is not at the border of what was seen has two triangles; a few have four.
    _, counts = np.unique(mesh.edges_sorted, axis=0, return_counts=True)
    shares = {int(count): round(float((counts == count).mean()), 4) for count in np.unique(counts)}
    print(f"    triangles per edge: {shares}; watertight parts: {len(mesh.split(only_watertight=True))}")
    assert shares.get(2, 0) > 0.9 and max(shares) <= 4, f"{path}: {shares}"
    return mesh, colours


if __name__ == "__main__":
    first, colours = check(Path(sys.argv[1]))
    for other in map(Path, sys.argv[2:]):
        mesh, others = check(other)
        assert (mesh.faces == first.faces).all(), f"{other}: other triangles"
        tolerance = 1e-4 * first.scale
        assert np.abs(mesh.vertices - first.vertices).max() < tolerance, f"{other}: other positions"
        assert np.abs(mesh.bounds - first.bounds).max() < tolerance, f"{other}: other bounds"
        assert np.abs(others - colours).max() < 1.5, f"{other}: other colours"
    print("trimesh can read the meshes")
