"""The folder of a run: its numbers, its model, and how it looks in a notebook."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Iterator
from os import fspath
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import _densify
from ._errors import InputError
from ._opened import Scores, evaluate, export, render, some_views
from ._progress import Listener
from ._scenes import Dataset, Model, Rendering, StrPath, png
from ._settings import Split


class Run:
    """A run in a folder, while it trains or afterwards."""

    def __init__(self, folder: StrPath, *, dataset: Dataset | None = None) -> None:
        self.folder = Path(folder)
        # A dataset in memory lasts as long as its run.
        self._dataset = dataset
        if not (self.folder / "config.toml").is_file():
            raise InputError(f"{self.folder} is not the folder of a run: it has no config.toml")

    def __fspath__(self) -> str:
        return fspath(self.folder)

    def __repr__(self) -> str:
        return f"<densify.Run {fspath(self.folder)!r}>"

    @property
    def config(self) -> dict[str, Any]:
        """The options with every choice made."""
        config: dict[str, Any] = json.loads(_densify.run_config(fspath(self.folder)))
        return config

    @property
    def summary(self) -> dict[str, Any]:
        """stats/summary.json: rows, peak, memory, times."""
        summary: dict[str, Any] = json.loads((self.folder / "stats" / "summary.json").read_text("utf-8"))
        return summary

    @property
    def scores(self) -> dict[str, float]:
        """Mean scores of the test views at the last measured iteration; empty without test views."""
        tests = self.tests
        return tests[max(tests)] if tests else {}

    @property
    def tests(self) -> dict[int, dict[str, float]]:
        """Mean scores of the test views at each measured iteration (``test_iterations``, and the last)."""
        path = self.folder / "results.json"
        entries: dict[str, dict[str, float]] = json.loads(path.read_text("utf-8")) if path.is_file() else {}
        return {int(name.rpartition("_")[2]): scores for name, scores in entries.items()}

    @property
    def curves(self) -> dict[str, NDArray[np.float64]]:
        """Columns of stats/train.jsonl: step, loss, l1, ssim, rows, seconds, …"""
        records = read_records(self.folder / "stats" / "train.jsonl")
        names = records[0] if records else {}
        return {name: np.array([record.get(name) for record in records], dtype=float) for name in names}

    @property
    def events(self) -> list[dict[str, Any]]:
        """The edits of the rows, in order."""
        return read_records(self.folder / "stats" / "events.jsonl")

    def model(self, iteration: int | None = None) -> Model:
        """The model of a saved iteration, by default the last."""
        return Model.load(self.folder, iteration=iteration)

    def evaluate(self, split: Split = "test", **more: Any) -> Scores:
        """Measures the model; see ``densify.evaluate``."""
        return evaluate(self, split=split, **more)

    def render(self, split: Split = "test", **more: Any) -> Iterator[Rendering]:
        """Renders the views of a split; see ``densify.render``."""
        return render(self, split=split, **more)

    def export(self, path: StrPath, **more: Any) -> Path:
        """Writes the model in another format; see ``densify.export``."""
        return export(self, path, **more)

    def report(self, path: StrPath | None = None, *, overwrite: bool = False) -> Path:
        """Writes the report on this run as one HTML file, by default report.html in its folder, which is replaced."""
        file = self.folder / "report.html" if path is None else Path(path)
        _densify.report(
            [fspath(self.folder)],
            fspath(file),
            "{}",
            iteration=None,
            overwrite=overwrite or path is None,
            listener=Listener(False),
        )
        return file

    def _repr_html_(self) -> str:
        parts = [f"<b>{html.escape(self.folder.name)}</b>"]
        rows = [(name, f"{value:.4g}") for name, value in self.scores.items()]
        try:
            summary = self.summary
            rows += [(name, f"{summary[name]:,}") for name in ("iterations", "rows", "peak_rows", "budget")]
        except (OSError, KeyError):
            pass
        cells = "".join(f"<tr><td>{html.escape(name)}</td><td>{value}</td></tr>" for name, value in rows)
        parts.append(f"<table>{cells}</table>")
        curves = self.curves
        if "loss" in curves and len(curves["loss"]) > 1:
            parts.append(_curve(curves["step"], curves["loss"], "loss"))
        try:
            split: Split = "test" if self.scores else "train"
            for view in some_views(self, split, 3):
                parts.append(_picture(view))
        except Exception as error:  # A picture is not worth the cell: the dataset may have moved.
            parts.append(f"<p>no pictures: {html.escape(str(error))}</p>")
        return "".join(parts)


def read_records(path: Path) -> list[dict[str, Any]]:
    if not path.is_file():
        return []
    # The last line of a run in training may be incomplete.
    lines = path.read_text("utf-8").splitlines(keepends=True)
    return [json.loads(line) for line in lines if line.endswith("\n")]


def _curve(steps: NDArray[np.float64], values: NDArray[np.float64], name: str) -> str:
    width, height = 480.0, 120.0
    across = width * (steps - steps[0]) / max(steps[-1] - steps[0], 1.0)
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    up = height - height * (values - low) / max(high - low, 1e-12)
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(across, up) if np.isfinite(y))
    return (
        f'<svg viewBox="-2 -2 {width + 4:.0f} {height + 24:.0f}" width="{width:.0f}">'
        f'<polyline points="{points}" fill="none" stroke="currentColor"/>'
        f'<text x="0" y="{height + 16:.0f}" font-size="12" fill="currentColor">'
        f"{html.escape(name)}: {high:.4g} to {values[-1]:.4g}, step {steps[-1]:.0f}</text></svg>"
    )


def _picture(view: Rendering) -> str:
    both = [view.pixels()] if view.photograph is None else [view.photograph, view.pixels()]
    data = base64.b64encode(png(np.concatenate(both, axis=1))).decode()
    name = html.escape(view.name, quote=True)
    return f'<figure><img alt="{name}" src="data:image/png;base64,{data}"><figcaption>{name}</figcaption></figure>'
