"""Cameras, renderings, models as arrays, and datasets from arrays."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike, fspath
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _densify
from ._errors import InputError

if TYPE_CHECKING:
    from PIL.Image import Image

StrPath: TypeAlias = str | PathLike[str]
#: Between OpenCV's axes and OpenGL's.
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera with OpenCV axes: x right, y down, z forward. Focal lengths and centre are in pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    camera_from_world: NDArray[np.float64]

    @staticmethod
    def from_matrices(camera_from_world: ArrayLike, intrinsics: ArrayLike, width: int, height: int) -> Camera:
        """A camera from a 4×4 matrix and a 3×3 matrix K, as gsplat's ``viewmats`` and ``Ks``."""
        k = np.asarray(intrinsics, dtype=np.float64)
        if k.shape != (3, 3):
            raise ValueError(f"intrinsics: expected an array of shape (3, 3), found {k.shape}")
        return Camera(width, height, k[0, 0], k[1, 1], k[0, 2], k[1, 2], _matrix(camera_from_world))

    @property
    def world_from_camera(self) -> NDArray[np.float64]:
        """The inverse of ``camera_from_world``."""
        return np.asarray(np.linalg.inv(_matrix(self.camera_from_world)), dtype=np.float64)

    def _parts(self) -> _densify._CameraParts:
        matrix = [[float(value) for value in row] for row in _matrix(self.camera_from_world)]
        lens = [float(value) for value in (self.fx, self.fy, self.cx, self.cy)]
        return int(self.width), int(self.height), lens, matrix

    @staticmethod
    def _of(parts: _densify._CameraParts) -> Camera:
        width, height, (fx, fy, cx, cy), rows = parts
        return Camera(width, height, fx, fy, cx, cy, np.array(rows))


def _matrix(given: ArrayLike) -> NDArray[np.float64]:
    matrix = np.asarray(given, dtype=np.float64)
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])
    if matrix.shape != (4, 4):
        raise ValueError(f"camera_from_world: expected an array of shape (4, 4), found {matrix.shape}")
    return matrix


@dataclass(frozen=True, eq=False)
class Rendering:
    """A rendered view; depth is Σ α·T·z in the units of the dataset or the model."""

    colour: NDArray[np.float32]
    alpha: NDArray[np.float32]
    depth: NDArray[np.float32]
    name: str = ""
    #: The photograph of the view, if there is one.
    photograph: NDArray[np.uint8] | None = None

    def pixels(self) -> NDArray[np.uint8]:
        """The colours with 8 bits per channel. Shape: [height, width, 3]."""
        return (np.clip(self.colour, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)

    def image(self) -> Image:
        """The colours as an image of PIL (``pip install pillow``)."""
        from PIL import Image

        return Image.fromarray(self.pixels())

    def save(self, path: StrPath) -> None:
        """Writes the colours as a PNG file."""
        _densify.write_image(fspath(path), np.ascontiguousarray(self.pixels()))

    def __repr__(self) -> str:
        height, width = self.alpha.shape
        return f"<densify.Rendering {self.name} {width}x{height}>"

    def _repr_png_(self) -> bytes:
        return png(self.pixels())


def png(pixels: NDArray[np.uint8]) -> bytes:
    """Pixels as a PNG file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "picture.png"
        _densify.write_image(fspath(path), np.ascontiguousarray(pixels))
        return path.read_bytes()


def colour_of(background: str | Sequence[float]) -> list[float]:
    """A background as three numbers."""
    named = {"black": [0.0] * 3, "white": [1.0] * 3}
    if isinstance(background, str):
        if background in named:
            return named[background]
        raise ValueError(f"background: `{background}` is not one of black, white; or give three numbers")
    colour = [float(channel) for channel in background]
    if len(colour) != 3 or not all(0.0 <= channel <= 1.0 for channel in colour):
        raise ValueError(f"background: expected three numbers from 0 to 1, found {background}")
    return colour


class Model:
    """Gaussians as arrays, all float32; each access returns a copy.

    ``means`` [rows, 3] relative to ``origin``, ``log_scales`` [rows, 3], ``quats`` [rows, 4] as w, x, y, z,
    ``opacity_logits`` [rows], ``sh`` [rows, k, 3] with k = 1, 4, 9 or 16.
    """

    def __init__(
        self,
        means: ArrayLike,
        log_scales: ArrayLike,
        quats: ArrayLike,
        opacity_logits: ArrayLike,
        sh: ArrayLike,
        *,
        origin: Sequence[float] = (0.0, 0.0, 0.0),
        antialias: str | None = None,
    ) -> None:
        if len(origin) != 3:
            raise ValueError(f"origin: expected three numbers, found {len(origin)}")
        place = [float(axis) for axis in origin]
        self._core = _densify.ModelArrays(
            means, log_scales, quats, opacity_logits, sh, origin=place, antialias=antialias
        )

    @classmethod
    def _of(cls, core: _densify.ModelArrays) -> Model:
        model = cls.__new__(cls)
        model._core = core
        return model

    @classmethod
    def load(cls, path: StrPath, *, iteration: int | None = None, antialias: str | None = None) -> Model:
        """Reads a file of Gaussian splats in any format, or the model of a run."""
        return cls._of(_densify.ModelArrays.load(fspath(path), iteration=iteration, antialias=antialias))

    def save(
        self,
        path: StrPath,
        *,
        format: str | None = None,
        coordinates: str = "auto",
        overwrite: bool = False,
    ) -> Path:
        """Writes the model; the extension or ``format`` selects the format."""
        self._core.save(fspath(path), format=format, coordinates=coordinates, overwrite=overwrite)
        return Path(path)

    def render(
        self,
        camera: Camera,
        *,
        background: str | Sequence[float] = "black",
        backend: str = "auto",
        threads: int | None = None,
    ) -> Rendering:
        """Renders one camera, in the model's own coordinates."""
        return self.render_all([camera], background=background, backend=backend, threads=threads)[0]

    def render_all(
        self,
        cameras: Sequence[Camera],
        *,
        background: str | Sequence[float] = "black",
        backend: str = "auto",
        threads: int | None = None,
    ) -> list[Rendering]:
        """Renders several cameras, which takes less time than one by one."""
        device = json.dumps({"backend": backend, "threads": threads})
        parts = [camera._parts() for camera in cameras]
        views = self._core.render(parts, colour_of(background), device)
        return [Rendering(*view) for view in views]

    def __len__(self) -> int:
        return len(self._core)

    def __repr__(self) -> str:
        return f"<densify.Model: {len(self):,} Gaussians, degree {self.sh_degree}>"

    def __reduce__(self) -> tuple[Any, ...]:
        arrays = (self.means, self.log_scales, self.quats, self.opacity_logits, self.sh)
        return _unpickled, (arrays, self.origin, self.antialias)

    @property
    def means(self) -> NDArray[np.float32]:
        return self._core.means

    @property
    def log_scales(self) -> NDArray[np.float32]:
        return self._core.log_scales

    @property
    def quats(self) -> NDArray[np.float32]:
        return self._core.quats

    @property
    def opacity_logits(self) -> NDArray[np.float32]:
        return self._core.opacity_logits

    @property
    def sh(self) -> NDArray[np.float32]:
        return self._core.sh

    @property
    def origin(self) -> tuple[float, float, float]:
        x, y, z = self._core.origin
        return x, y, z

    @property
    def sh_degree(self) -> int:
        return self._core.sh_degree

    @property
    def antialias(self) -> str:
        return self._core.antialias


def _unpickled(arrays: tuple[Any, ...], origin: Sequence[float], antialias: str) -> Model:
    return Model(*arrays, origin=origin, antialias=antialias)


def write_dataset(
    folder: StrPath,
    images: Sequence[ArrayLike],
    cameras: Sequence[Camera],
    *,
    names: Sequence[str] | None = None,
    points: ArrayLike | None = None,
    colours: ArrayLike | None = None,
    test: Sequence[int] = (),
) -> Path:
    """Writes a dataset that densify and nerfstudio read: transforms.json, PNG files, and the points.

    Images are uint8, or float in [0, 1], of shape [height, width, 3] or [height, width, 4] (straight alpha). ``points``
    [n, 3] are where Gaussians start, ``colours`` [n, 3] are uint8 or in [0, 1]. ``test`` are the views to hold out.
    """
    folder = Path(folder)
    if len(images) != len(cameras) or len(images) == 0:
        raise ValueError(f"images and cameras: expected as many of each, found {len(images)} and {len(cameras)}")
    if folder.exists() and any(folder.iterdir()):
        raise InputError(f"{folder} is not empty; name another folder")
    chosen = [f"{view:05}" for view in range(len(images))] if names is None else list(names)
    if len(set(chosen)) != len(images) or any("/" in name or "\\" in name or not name for name in chosen):
        raise ValueError("names: expected one file name without folders per image, all different")
    held_out = set(test)
    if not held_out <= set(range(len(images))):
        raise IndexError(f"test: there are views 0 to {len(images) - 1}, found {sorted(held_out)}")
    pixels = [_pixels(image, f"image {view}") for view, image in enumerate(images)]
    frames = []
    for view, (image, camera) in enumerate(zip(pixels, cameras)):
        width, height, (fx, fy, cx, cy), rows = camera._parts()
        if image.shape[:2] != (height, width):
            raise ValueError(f"image {view} is {image.shape[1]}x{image.shape[0]}, but its camera is {width}x{height}")
        if not np.isfinite(rows).all():
            raise ValueError(f"camera {view} has a value that is not finite")
        # The file has OpenGL axes: y up, looking along −z.
        pose = np.linalg.inv(np.array(rows)) @ _FLIP
        frames.append(
            {
                "file_path": f"images/{chosen[view]}.png",
                "transform_matrix": pose.tolist(),
                "w": width,
                "h": height,
                "fl_x": fx,
                "fl_y": fy,
                "cx": cx,
                "cy": cy,
            }
        )
    scene: dict[str, Any] = {"camera_model": "PINHOLE", "frames": frames}
    if held_out:
        paths = [frame["file_path"] for frame in frames]
        scene["train_filenames"] = [path for view, path in enumerate(paths) if view not in held_out]
        scene["test_filenames"] = [path for view, path in enumerate(paths) if view in held_out]
    cloud = None if points is None else _cloud(points, colours)
    (folder / "images").mkdir(parents=True, exist_ok=True)
    for name, image in zip(chosen, pixels):
        _densify.write_image(fspath(folder / "images" / f"{name}.png"), np.ascontiguousarray(image))
    if cloud is not None:
        (folder / "points3d.ply").write_bytes(cloud)
        scene["ply_file_path"] = "points3d.ply"
    # The file appears last and whole: without it, the folder is no dataset.
    partial = folder / ".transforms.json.partial"
    partial.write_text(json.dumps(scene, allow_nan=False), encoding="utf-8")
    os.replace(partial, folder / "transforms.json")
    return folder


def _pixels(given: ArrayLike, name: str) -> NDArray[np.uint8]:
    image = np.asarray(given)
    if image.ndim != 3 or image.shape[2] not in (3, 4) or 0 in image.shape:
        raise ValueError(
            f"{name}: expected an array of shape [height, width, 3] or [height, width, 4], found {image.shape}"
        )
    if image.dtype == np.uint8:
        return image
    if image.dtype.kind != "f":
        raise TypeError(f"{name}: expected uint8, or floats from 0 to 1, found {image.dtype}")
    if not np.isfinite(image).all() or image.min() < 0.0 or image.max() > 1.0:
        raise ValueError(f"{name}: floats must be from 0 to 1")
    return (image * 255.0 + 0.5).astype(np.uint8)


def _cloud(points: ArrayLike, colours: ArrayLike | None) -> bytes:
    positions = np.asarray(points, dtype=np.float64)
    if positions.ndim != 2 or positions.shape[1] != 3:
        raise ValueError(f"points: expected an array of shape [n, 3], found {positions.shape}")
    if not np.isfinite(positions).all():
        raise ValueError("points: a value is not finite")
    shape = (len(positions), 3)
    tint = np.full(shape, 128, np.uint8) if colours is None else np.asarray(colours)
    if tint.shape != shape:
        raise ValueError(f"colours: expected an array of shape {list(shape)}, found {tint.shape}")
    if tint.dtype != np.uint8:
        tint = _pixels(tint[None].astype(np.float64), "colours")[0]
    fields = [(axis, "<f8") for axis in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
    rows = np.empty(len(positions), dtype=fields)
    for column, axis in enumerate("xyz"):
        rows[axis] = positions[:, column]
    for column, name in enumerate(("red", "green", "blue")):
        rows[name] = tint[:, column]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    lines += [f"property double {axis}" for axis in "xyz"]
    lines += [f"property uchar {name}" for name in ("red", "green", "blue")]
    return ("\n".join([*lines, "end_header"]) + "\n").encode() + rows.tobytes()


class Dataset:
    """A dataset in memory, as ``write_dataset`` takes it.

    It is written to a temporary folder, which lasts as long as this object: to resume a run later, or to measure it,
    write the dataset to a folder of your own with ``write_dataset``.
    """

    def __init__(self, images: Sequence[ArrayLike], cameras: Sequence[Camera], **more: Any) -> None:
        folder = Path(tempfile.mkdtemp(prefix="densify-"))
        self._finalizer = weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        self.folder = write_dataset(folder, images, cameras, **more)

    def __fspath__(self) -> str:
        return fspath(self.folder)


def plain(options: Mapping[str, Any]) -> str:
    """Options as JSON: paths as text, numbers of numpy as plain ones."""

    def convert(value: Any) -> Any:
        if isinstance(value, PathLike):
            return fspath(value)
        if isinstance(value, np.generic):
            return value.item()
        if isinstance(value, np.ndarray):
            return value.tolist()
        raise TypeError(f"{value!r} cannot be the value of an option")

    try:
        return json.dumps(dict(options), default=convert, allow_nan=False)
    except ValueError as error:
        raise ValueError(f"options: {error}; numbers must be finite") from None
