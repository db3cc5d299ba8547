"""Checks the scene that `densify poses` wrote against the true cameras: python poses.py TRUE_SCENE FOUND_SCENE

At least nine of ten photographs must have a pose, and none may be wrong by more than 1 degree or 1 % of the extent. The
scenes are aligned as photographs of known poses need it: rotations first, then scale and translation by medians, so
that a wrong pose does not spoil the alignment.
"""

import sys

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation


def poses(folder, prefix=""):
    """Rotation and centre by name."""
    model = pycolmap.Reconstruction(f"{folder}/sparse/0")
    found = {}
    for image in model.images.values():
        if image.has_pose and image.name.startswith(prefix):
            pose = image.cam_from_world()
            rotation = Rotation.from_quat(pose.rotation.quat)
            found[image.name.removeprefix(prefix)] = (rotation, -rotation.inv().apply(pose.translation))
    return found


def robust_mean(rotations):
    """The rotation with the least sum of angles to all."""
    quaternions = Rotation.from_quat([rotation.as_quat() for rotation in rotations])
    angles = [np.median((rotation.inv() * quaternions).magnitude()) for rotation in rotations]
    mean = rotations[int(np.argmin(angles))]
    for _ in range(50):
        steps = (mean.inv() * quaternions).as_rotvec()
        weights = 1 / np.maximum(np.linalg.norm(steps, axis=1), 1e-4)
        mean = mean * Rotation.from_rotvec((steps * weights[:, None]).sum(0) / weights.sum())
    return mean


def errors(true, found):
    """Errors of each view: rotation [degrees], centre [% of the extent]."""
    names = sorted(found)
    turn = robust_mean([true[name][0].inv() * found[name][0] for name in names])
    known = np.array([true[name][1] for name in names])
    placed = np.array([turn.apply(found[name][1]) for name in names])
    first, second = np.triu_indices(len(names), 1)
    lengths = [np.linalg.norm(centres[first] - centres[second], axis=1) for centres in (known, placed)]
    scale = np.median(lengths[0] / np.maximum(lengths[1], 1e-12))
    shift = np.median(known - scale * placed, axis=0)
    everywhere = np.array([centre for _, centre in true.values()])
    extent = 1.1 * np.linalg.norm(everywhere - everywhere.mean(0), axis=1).max()
    rotations = [np.degrees((true[name][0] * turn * found[name][0].inv()).magnitude()) for name in names]
    centres = 100 / extent * np.linalg.norm(known - scale * placed - shift, axis=1)
    return np.array(rotations), centres


def main():
    true, found = poses(sys.argv[1], "train/"), poses(sys.argv[2])
    rotations, centres = errors(true, found)
    print(
        f"{len(found)} of {len(true)} photographs; median and largest error: rotation {np.median(rotations):.2f} and "
        f"{rotations.max():.2f} degrees, centre {np.median(centres):.2f} and {centres.max():.2f} % of the extent"
    )
    assert len(found) >= 0.9 * len(true), "too few photographs have a pose"
    assert rotations.max() <= 1 and centres.max() <= 1, "a wrong pose was accepted"


if __name__ == "__main__":
    main()
