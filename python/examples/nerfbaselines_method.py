"""densify as a method of NerfBaselines (https://nerfbaselines.github.io): save it where the method's spec names it."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import densify

try:
    from nerfbaselines import Method  # type: ignore[import-not-found, unused-ignore]
except ImportError:  # The example runs without NerfBaselines, too.
    Method = object


def cameras(given: Any) -> list[densify.Camera]:
    """NerfBaselines' cameras: camera-to-world matrices with OpenCV axes, and fx, fy, cx, cy."""
    found = []
    for pose, (fx, fy, cx, cy), (width, height) in zip(given.poses, given.intrinsics, given.image_sizes):
        world_from_camera = np.vstack([np.asarray(pose)[:3], [0.0, 0.0, 0.0, 1.0]])
        camera_from_world = np.linalg.inv(world_from_camera)
        found.append(densify.Camera(int(width), int(height), fx, fy, cx, cy, camera_from_world))
    return found


class Densify(Method):  # type: ignore[misc]
    """Trains step by step; renders while it trains, and from a checkpoint afterwards."""

    def __init__(
        self,
        *,
        checkpoint: str | None = None,
        train_dataset: Any = None,
        config_overrides: dict[str, Any] | None = None,
    ) -> None:
        self.checkpoint = None if checkpoint is None else Path(checkpoint)
        self.trainer: densify.Trainer | None = None
        self.model: densify.Model | None = None
        self.options: dict[str, Any] = {"iterations": 30_000, **(config_overrides or {})}
        if self.checkpoint is not None:
            self.options = json.loads((self.checkpoint / "options.json").read_text())
            self.model = densify.Model.load(self.checkpoint / "model.ply")
        if train_dataset is not None:
            # NerfBaselines' cameras are undistorted if the method supports pinholes only.
            self.folder = tempfile.TemporaryDirectory()
            data = densify.write_dataset(
                Path(self.folder.name) / "data",
                [np.asarray(image)[..., :3] for image in train_dataset["images"]],
                cameras(train_dataset["cameras"]),
                points=train_dataset["points3D_xyz"],
                colours=train_dataset["points3D_rgb"],
            )
            start = {} if self.checkpoint is None else {"init": self.checkpoint / "model.ply"}
            self.trainer = densify.prepare(data, **{**self.options, **start})

    @classmethod
    def get_method_info(cls) -> dict[str, Any]:
        return {
            "method_id": "densify",
            "required_features": frozenset(("points3D_xyz", "images")),
            "supported_camera_models": frozenset(("pinhole",)),
            "supported_outputs": ("color", "depth", "accumulation"),
        }

    def get_info(self) -> dict[str, Any]:
        step = self.trainer.steps_done if self.trainer is not None else self.options["iterations"]
        return {
            **self.get_method_info(),
            "hparams": self.options,
            "num_iterations": self.options["iterations"],
            "loaded_step": step if self.checkpoint is not None else None,
        }

    def train_iteration(self, step: int) -> dict[str, float]:
        assert self.trainer is not None, "no training dataset was given"
        done = self.trainer.step()
        return {"loss": done.loss, "l1": done.l1, "ssim": done.ssim, "num_gaussians": done.rows}

    def render(self, camera: Any, *, options: Any = None) -> dict[str, Any]:
        view = cameras(camera if np.asarray(camera.poses).ndim == 3 else camera[None])[0]
        source = self.trainer if self.trainer is not None else self.model
        assert source is not None, "give a checkpoint or a training dataset"
        rendering = source.render(view)
        return {"color": rendering.colour, "depth": rendering.depth, "accumulation": rendering.alpha}

    def save(self, path: str) -> None:
        folder = Path(path)
        folder.mkdir(parents=True, exist_ok=True)
        model = self.trainer.model() if self.trainer is not None else self.model
        assert model is not None, "there is no model to save"
        model.save(folder / "model.ply", overwrite=True)
        (folder / "options.json").write_text(json.dumps(self.options))
