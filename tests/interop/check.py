"""Reads a dataset of `densify scenegen` with COLMAP's library, and by the steps of nerfstudio's parser.

    python check.py FOLDER          needs the packages of requirements.txt
"""

import json
import sys
import tempfile
from pathlib import Path

import numpy as np
import pycolmap


def colmap(root: Path) -> None:
    """Checks that COLMAP reads the model without complaint and computes the stored errors."""
    model = pycolmap.Reconstruction(root / "sparse/0")
    print(model.summary())
    names = {image.name for image in model.images.values()}
    files = {str(file.relative_to(root / "images")) for file in (root / "images").rglob("*.png")}
    assert names == files, names ^ files
    assert model.num_reg_images() == len(files) == len(model.cameras)
    stored = {i: point.error for i, point in model.points3D.items()}
    for i, point in model.points3D.items():
        for element in point.track.elements:
            image = model.images[element.image_id]
            feature = image.points2D[element.point2D_idx]
            assert feature.point3D_id == i, f"point {i}: its feature belongs to another point"
            assert image.project_point(point.xyz) is not None, f"point {i} is behind {image.name}"
    model.update_point_3d_errors()
    for i, point in model.points3D.items():
        if point.track.length():
            assert np.isclose(point.error, stored[i], rtol=1e-6, atol=1e-6), f"point {i}"
    tracked = [point.error for point in model.points3D.values() if point.track.length()]
    assert len(tracked) > 100 and 0 < np.median(tracked) < 2, "the errors are not plausible for noise"
    # COLMAP can write the model, too.
    with tempfile.TemporaryDirectory() as written:
        model.write_binary(written)
        assert pycolmap.Reconstruction(written).num_points3D() == len(stored)


def nerfstudio(root: Path) -> None:
    """Follows nerfstudio_dataparser.py and depth_dataset.py of nerfstudio 1.1."""
    meta = json.loads((root / "transforms.json").read_text())
    names = [root / frame["file_path"] for frame in meta["frames"]]
    for split in ("train", "val", "test"):
        chosen = {root / name for name in meta[f"{split}_filenames"]}
        assert chosen and chosen <= set(names), split
    for frame, name in zip(meta["frames"], names):
        assert name.is_file() and np.array(frame["transform_matrix"]).shape == (4, 4), name
        depth = np.load(root / frame["depth_file_path"]).astype(np.float32) * 1e-3
        assert depth.shape == (meta["h"], meta["w"]) and depth.max() > 0, name
    # The cameras are those of COLMAP with the y and z axes flipped.
    model = pycolmap.Reconstruction(root / "sparse/0")
    poses = {image.name: image.cam_from_world() for image in model.images.values()}
    for frame in meta["frames"]:
        pose = np.linalg.inv(np.array(frame["transform_matrix"]) @ np.diag([1, -1, -1, 1]))
        expected = poses[frame["file_path"].removeprefix("images/")].matrix()
        assert np.allclose(pose[:3], expected, atol=1e-9), frame["file_path"]


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    colmap(folder)
    nerfstudio(folder)
    print(f"{folder}: COLMAP and nerfstudio can read it")
