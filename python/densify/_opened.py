"""Finished runs and model files, opened to measure, render and export them."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from os import fspath
from pathlib import Path
from typing import Any

import numpy as np

from . import _densify
from ._progress import Listener
from ._scenes import Camera, Rendering, StrPath
from ._settings import RunOrModel, Scene, Split, table_of
from ._signals import noting


@dataclass(frozen=True)
class Scores:
    """Scores of a model: their mean over views, those of each view, and the geometry where it is known."""

    mean: dict[str, float]
    views: dict[str, dict[str, float]] = field(repr=False)
    geometry: dict[str, Any] | None = field(default=None, repr=False)

    @property
    def psnr(self) -> float:
        """Mean peak signal-to-noise ratio [dB]."""
        return self.mean["PSNR"]

    @property
    def ssim(self) -> float:
        """Mean structural similarity."""
        return self.mean["SSIM"]


def _open(
    model: RunOrModel, scene: Scene | None, iteration: int | None, antialias: str | None, options: Mapping[str, Any]
) -> _densify.OpenedModel:
    return _densify.open_model(
        fspath(model),
        table_of(scene, None, None, options),
        iteration=iteration,
        antialias=antialias,
        listener=Listener(False),
    )


def some_views(model: RunOrModel, split: Split, count: int) -> Iterator[Rendering]:
    opened = _open(model, None, None, None, {})
    views = opened.views(split)
    for view in np.unique(np.linspace(0, len(views) - 1, min(count, len(views))).astype(int)):
        yield _render_view(opened, split, int(view), views[view][0])


def _render_view(opened: _densify.OpenedModel, split: Split, view: int, name: str) -> Rendering:
    (colour, alpha, depth), photograph = opened.render(split, view)
    return Rendering(colour, alpha, depth, name, photograph)


def evaluate(
    model: RunOrModel,
    *,
    split: Split = "test",
    scene: Scene | None = None,
    iteration: int | None = None,
    lpips: StrPath | None = None,
    fit_exposure: bool = False,
    antialias: str | None = None,
    **options: Any,
) -> Scores:
    """Measures a model against the photographs of its scene, as ``densify eval`` does.

    The scores of a run are also written to its folder. A model file needs ``scene``.
    """
    stop = _densify.Stop()
    opened = _open(model, scene, iteration, antialias, options)
    with noting(stop):
        text = opened.evaluate(
            split,
            lpips=None if lpips is None else fspath(lpips),
            fit_exposure=fit_exposure,
            listener=Listener(False),
            stop=stop,
        )
    views, mean, geometry = json.loads(text)
    names = ("PSNR", "SSIM", "FLIP", "LPIPS")
    by_view = {name: {key: value for key, value in zip(names, values) if value is not None} for name, *values in views}
    return Scores(mean, by_view, geometry)


def render(
    model: RunOrModel,
    *,
    split: Split = "test",
    scene: Scene | None = None,
    iteration: int | None = None,
    antialias: str | None = None,
    **options: Any,
) -> Iterator[Rendering]:
    """Renders the views of a split one after another, with their photographs. A model file needs ``scene``."""
    opened = _open(model, scene, iteration, antialias, options)
    names = [name for name, _ in opened.views(split)]
    return (_render_view(opened, split, view, name) for view, name in enumerate(names))


def cameras(model: RunOrModel, *, split: Split = "test", scene: Scene | None = None) -> dict[str, Camera]:
    """The cameras of a split by name, in the dataset's own coordinates."""
    opened = _open(model, scene, None, None, {})
    return {name: Camera._of(parts) for name, parts in opened.views(split)}


def export(
    model: RunOrModel,
    output: StrPath,
    *,
    format: str | None = None,
    iteration: int | None = None,
    coordinates: str = "auto",
    overwrite: bool = False,
    antialias: str | None = None,
    progress: bool = True,
) -> Path:
    """Writes a model in another format: ply, spz, sog, glb, … as ``densify export`` does."""
    listener = Listener(progress)
    core = _densify.ModelArrays.load(fspath(model), iteration=iteration, antialias=antialias, listener=listener)
    core.save(fspath(output), format=format, coordinates=coordinates, overwrite=overwrite, listener=listener)
    return Path(output)
