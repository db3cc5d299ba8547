"""The examples run on the processor."""

from __future__ import annotations

import io
import pickle
import sys
import types
import zipfile
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import densify

from .conftest import cameras, images

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))

import gsplat_tensors  # noqa: E402
import nerfbaselines_method  # noqa: E402


def save_as_torch(path: Path, tensors: dict[str, np.ndarray], extra: Any = None) -> None:
    """Writes the file that torch.save would write: a pickle that names storages, and the storages."""
    torch, utils = types.ModuleType("torch"), types.ModuleType("torch._utils")

    class FloatStorage:
        def __init__(self, key: str, values: np.ndarray) -> None:
            self.key, self.values = key, values

    def _rebuild_tensor_v2() -> None: ...

    for made, module in ((FloatStorage, torch), (_rebuild_tensor_v2, utils)):
        made.__module__, made.__qualname__ = module.__name__, made.__name__
        setattr(module, made.__name__, made)

    class Tensor:
        def __init__(self, key: str, values: np.ndarray) -> None:
            self.storage, self.shape = FloatStorage(key, values), values.shape

        def __reduce__(self) -> Any:
            strides = tuple(np.cumprod((1, *self.shape[:0:-1])).tolist()[::-1])
            return _rebuild_tensor_v2, (self.storage, 0, self.shape, strides, False, OrderedDict())

    class Writer(pickle.Pickler):
        def persistent_id(self, value: Any) -> Any:
            if isinstance(value, FloatStorage):
                return "storage", FloatStorage, value.key, "cpu", value.values.size
            return None

    buffer = io.BytesIO()
    made = {name: Tensor(str(key), values) for key, (name, values) in enumerate(tensors.items())}
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "torch", torch)
        patch.setitem(sys.modules, "torch._utils", utils)
        Writer(buffer, protocol=2).dump({"step": 6999, "splats": made, **({"extra": extra} if extra else {})})
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", buffer.getvalue())
        for key, values in enumerate(tensors.values()):
            archive.writestr(f"archive/data/{key}", values.astype("<f4").tobytes())


def test_tensors_of_gsplat_go_in_and_out(scene: Path, run: densify.Run, tmp_path: Path) -> None:
    given = gsplat_tensors.to_splats(run.model())
    save_as_torch(tmp_path / "ckpt.pt", given)
    read = gsplat_tensors.read(tmp_path / "ckpt.pt")
    assert all((read[name] == values).all() for name, values in given.items())
    back = gsplat_tensors.to_splats(gsplat_tensors.to_model(read))
    assert set(back) == set(given) and all((back[name] == values).all() for name, values in given.items())
    gsplat_tensors.main(
        str(tmp_path / "ckpt.pt"),
        str(scene),
        str(tmp_path / "trained.npz"),
        iterations=20,
        budget=300,
        policy="vanilla",
        backend="cpu",
        progress=False,
    )
    trained = gsplat_tensors.read(tmp_path / "trained.npz")
    shapes = {name: values.shape for name, values in given.items()}
    assert {name: values.shape for name, values in trained.items()} == shapes
    assert not (trained["means"] == given["means"]).all()


def test_a_file_of_tensors_cannot_run_code(tmp_path: Path) -> None:
    save_as_torch(tmp_path / "evil.pt", {"means": np.zeros((2, 3))}, extra=print)
    with pytest.raises(ValueError, match="print"):
        gsplat_tensors.read(tmp_path / "evil.pt")


class Cameras:
    """The fields of NerfBaselines' cameras."""

    def __init__(self, given: list[densify.Camera]) -> None:
        self.poses = np.array([camera.world_from_camera[:3] for camera in given])
        self.intrinsics = np.array([(camera.fx, camera.fy, camera.cx, camera.cy) for camera in given])
        self.image_sizes = np.array([(camera.width, camera.height) for camera in given])


def test_a_method_of_nerfbaselines(tmp_path: Path) -> None:
    dataset = {
        "images": images(4),
        "cameras": Cameras(cameras(4)),
        "points3D_xyz": np.random.default_rng(2).normal(size=(80, 3)),
        "points3D_rgb": np.full((80, 3), 100, np.uint8),
    }
    overrides = {"iterations": 10, "budget": 100, "backend": "cpu"}
    method = nerfbaselines_method.Densify(train_dataset=dataset, config_overrides=overrides)
    assert method.get_info()["num_iterations"] == 10
    losses = [method.train_iteration(step)["loss"] for step in range(10)]
    assert np.isfinite(losses).all()
    first = Cameras(cameras(4)[:1])
    rendered = method.render(first)
    assert rendered["color"].shape == (24, 32, 3) and rendered["depth"].shape == (24, 32)
    method.save(str(tmp_path / "checkpoint"))
    again = nerfbaselines_method.Densify(checkpoint=str(tmp_path / "checkpoint"))
    # The near plane and the scene's unit follow from other data, so the last bits differ.
    assert again.render(first)["color"] == pytest.approx(rendered["color"], abs=1e-3)
