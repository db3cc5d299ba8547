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
    colours = mesh.visual.vertex_colors[:, :3].astype(float)
    # glTF's colours are linear; trimesh keeps them in 8 bits.
    return mesh, 255 * encoded(colours / 255) if path.suffix == ".glb" else colours


def check(path: Path) -> tuple[trimesh.Trimesh, np.ndarray]:
    mesh, colours = read(path)
    print(f"{path.name}: {len(mesh.vertices)} vertices, {len(mesh.faces)} faces, watertight: {mesh.is_watertight}")
    assert len(mesh.faces) > 100 and len(colours) == len(mesh.vertices), path
    assert np.isfinite(mesh.vertices).all() and (mesh.area_faces >= 0).all(), path
    # Each vertex is used, no triangle occurs twice, and neighbours agree on what is outside.
    assert len(np.unique(mesh.faces)) == len(mesh.vertices), f"{path}: unused vertices"
    assert len(np.unique(np.sort(mesh.faces, axis=1), axis=0)) == len(mesh.faces), f"{path}: triangles occur twice"
    assert mesh.is_winding_consistent, f"{path}: neighbouring triangles face opposite sides"
    assert colours.std() > 5, f"{path}: the colours are uniform"
    # The parts without a border enclose space, and are not inside out.
    closed = [part for part in mesh.split(only_watertight=True)]
    print(f"    {len(closed)} closed parts of {mesh.body_count}")
    for part in closed:
        assert part.volume > 0, f"{path}: a part of {len(part.faces)} faces is inside out"
    return mesh, colours


if __name__ == "__main__":
    first, colours = check(Path(sys.argv[1]))
    for other in map(Path, sys.argv[2:]):
        mesh, others = check(other)
        assert (mesh.faces == first.faces).all(), f"{other}: other triangles"
        tolerance = 1e-4 * first.scale
        assert np.abs(mesh.vertices - first.vertices).max() < tolerance, f"{other}: other positions"
        assert np.abs(mesh.bounds - first.bounds).max() < tolerance, f"{other}: other bounds"
        # Linear values in 8 bits are coarse for dark colours.
        assert np.abs(others - colours).mean() < 4, f"{other}: other colours"
    print("trimesh can read the meshes")
