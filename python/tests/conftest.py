"""Scenes and runs that several tests share."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import densify

#: Options of runs that take a fraction of a second.
SMALL = {"iterations": 60, "budget": 300, "init_points": 200, "init": "random", "threads": 2, "backend": "cpu"}

#: Windows has neither SIGINT for a single process nor names with `<`.
not_on_windows = pytest.mark.skipif(sys.platform == "win32", reason="Windows cannot do this")


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Built-in scenes are cached here, not in the user's folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", os.fspath(tmp_path_factory.mktemp("cache")))
        yield


def cameras(count: int, width: int = 32, height: int = 24) -> list[densify.Camera]:
    """Cameras on an arc that look at the origin."""
    found = []
    for angle in np.linspace(-0.6, 0.6, count):
        cos, sin = np.cos(angle), np.sin(angle)
        rotation = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, [0.0, 0.0, 4.0]
        found.append(densify.Camera(width, height, 40.0, 40.0, width / 2, height / 2, pose))
    return found


def images(count: int, width: int = 32, height: int = 24) -> list[np.ndarray]:
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    planes = [np.stack([8 * x, 10 * y, 20 * view + 4 * (x ^ y)], axis=-1) for view in range(count)]
    return [(plane % 256).astype(np.uint8) for plane in planes]


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of six views, two of them held out."""
    folder = tmp_path_factory.mktemp("data") / "scene"
    rng = np.random.default_rng(1)
    return densify.write_dataset(folder, images(6), cameras(6), points=rng.normal(size=(150, 3)), test=[2, 4])


@pytest.fixture(scope="session")
def run(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> densify.Run:
    """A finished run."""
    output = tmp_path_factory.mktemp("runs") / "run"
    return densify.train(
        scene, output=output, eval=True, progress=False, **{**SMALL, "init": "points", "init_points": None}
    )
