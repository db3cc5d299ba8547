"""Starts a run from the tensors that gsplat has saved, and gives them back; torch is not needed.

    python gsplat_tensors.py ckpt_6999_rank0.pt data/garden trained.npz

The names and shapes are gsplat's: means, scales (logarithms), quats (wxyz), opacities (logits), sh0, shN. With torch:
``{name: torch.from_numpy(values) for name, values in numpy.load("trained.npz").items()}``.
"""

from __future__ import annotations

import io
import pickle
import sys
import tempfile
import zipfile
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import densify

#: numpy types of torch's storages.
STORAGES = {
    "FloatStorage": "<f4",
    "DoubleStorage": "<f8",
    "HalfStorage": "<f2",
    "LongStorage": "<i8",
    "IntStorage": "<i4",
}


class Reader(pickle.Unpickler):
    """Reads the pickle of a .pt file. It knows tensors and dictionaries only, so a file cannot run code."""

    def __init__(self, archive: zipfile.ZipFile, root: str) -> None:
        super().__init__(io.BytesIO(archive.read(f"{root}/data.pkl")))
        self.archive, self.root = archive, root

    def find_class(self, module: str, name: str) -> Any:
        known: dict[tuple[str, str], Any] = {
            ("torch._utils", "_rebuild_tensor_v2"): rebuild,
            ("torch._utils", "_rebuild_parameter"): lambda data, *more: data,
            ("collections", "OrderedDict"): OrderedDict,
        }
        if module == "torch" and name in STORAGES:
            return STORAGES[name]
        if (module, name) in known:
            return known[module, name]
        raise ValueError(f"the file holds {module}.{name}; save only the tensors: torch.save(splats.state_dict(), …)")

    def persistent_load(self, pid: Any) -> NDArray[Any]:
        _, dtype, key, _, count = pid
        values = np.frombuffer(self.archive.read(f"{self.root}/data/{key}"), dtype)
        if len(values) < count:
            raise ValueError("the file is damaged: a tensor is too short")
        return values


def rebuild(storage: NDArray[Any], offset: int, shape: Any, strides: Any, *more: Any) -> NDArray[Any]:
    """A tensor as a contiguous array."""
    rows = np.arange(int(np.prod(shape, dtype=np.int64))) if shape else np.zeros(1, int)
    places = np.full(len(rows), offset)
    for axis, place in enumerate(np.unravel_index(rows, tuple(shape)) if shape else ()):
        places = places + place * strides[axis]
    values: NDArray[Any] = storage[places].reshape(tuple(shape))
    return values


def read(path: Path) -> dict[str, NDArray[Any]]:
    """The tensors of a .pt or .npz file."""
    if path.suffix == ".npz":
        return dict(np.load(path, allow_pickle=False).items())
    with zipfile.ZipFile(path) as archive:
        root = next(name for name in archive.namelist() if name.endswith("/data.pkl")).removesuffix("/data.pkl")
        loaded = Reader(archive, root).load()
    splats = loaded.get("splats", loaded)
    return {name.removeprefix("params."): values for name, values in splats.items()}


def to_model(splats: dict[str, NDArray[Any]]) -> densify.Model:
    """gsplat's tensors as a model."""
    sh = np.concatenate([splats["sh0"], splats["shN"]], axis=1)
    return densify.Model(splats["means"], splats["scales"], splats["quats"], splats["opacities"], sh)


def to_splats(model: densify.Model) -> dict[str, NDArray[Any]]:
    """A model as gsplat's tensors."""
    return {
        "means": model.means + np.array(model.origin, np.float32),
        "scales": model.log_scales,
        "quats": model.quats,
        "opacities": model.opacity_logits,
        "sh0": model.sh[:, :1],
        "shN": model.sh[:, 1:],
    }


def main(source: str, scene: str, output: str, **options: Any) -> None:
    """Trains on from the tensors of a file."""
    with tempfile.TemporaryDirectory() as folder:
        start = to_model(read(Path(source))).save(Path(folder) / "start.ply")
        run = densify.train(scene, init=start, output=Path(folder) / "run", **options)
        np.savez(output, **to_splats(run.model()))  # type: ignore[arg-type]


if __name__ == "__main__":
    main(*sys.argv[1:4])
