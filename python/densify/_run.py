"""Runs: training, stepping, and everything that is done with a finished run."""

from __future__ import annotations

import base64
import html
import json
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from os import fspath
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, cast

import numpy as np
from numpy.typing import NDArray

from . import _densify, _policy
from ._errors import InputError, Interrupted
from ._progress import Listener
from ._scenes import Camera, Dataset, Model, Rendering, StrPath, colour_of, plain
from ._signals import noting

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from ._options import Options

Split = Literal["train", "test"]
Scene: TypeAlias = StrPath | Dataset
#: A policy by name, or a class or an instance made with @densify.policy.
PolicyLike: TypeAlias = str | object
#: A run, its folder, or a model file.
RunOrModel: TypeAlias = "Run | StrPath"


def _table(
    scene: Scene | None, policy: PolicyLike | None, output: StrPath | None, options: Mapping[str, Any]
) -> str:
    """The options of a run as JSON."""
    table = dict(options)
    if scene is not None:
        table["scene"] = fspath(scene)
    if output is not None:
        table["output"] = fspath(output)
    _policy.load_installed()
    if policy is not None:
        name, settings, file = _policy.name_and_settings(policy)
        table["policy"] = name
        if settings:
            given = dict(table.get("policy_set") or {})
            given[name] = {**settings, **given.get(name, {})}
            table["policy_set"] = given
        if file is not None:
            files = [str(known) for known in table.get("policy_file") or ()]
            table["policy_file"] = files if file in files else [*files, file]
    return plain(table)


@dataclass(frozen=True)
class Step:
    """One iteration: the view that was trained on, its loss and scores, and the edits of the rows."""

    step: int
    view: int
    name: str
    loss: float
    l1: float
    ssim: float
    rows: int
    events: list[dict[str, Any]]


@dataclass(frozen=True)
class Buffer:
    """A line of the table of memory."""

    section: str
    what: str
    bytes: int


@dataclass(frozen=True)
class MemoryPlan:
    """The memory of a run: every buffer, the total, and other sizes that fit the same memory."""

    ledger: list[Buffer]
    total_bytes: int
    text: str
    #: Rows that fit ``memory`` at each degree, for each resolution in ``resolutions``.
    memory: int
    resolutions: list[int]
    rows: list[list[int | None]]

    def __str__(self) -> str:
        return self.text


@dataclass(frozen=True)
class Scores:
    """Scores of a model: their mean over views, those of each view, and the geometry where it is known."""

    mean: dict[str, float]
    views: dict[str, dict[str, float]]
    geometry: dict[str, Any] | None = None

    @property
    def psnr(self) -> float:
        """Mean peak signal-to-noise ratio [dB]."""
        return self.mean["PSNR"]

    @property
    def ssim(self) -> float:
        """Mean structural similarity."""
        return self.mean["SSIM"]


@dataclass(frozen=True)
class Attempt:
    """A model of ``compress``: "whole", "stage", "tried" or "written"."""

    kind: str
    rows: int
    sh_degree: int
    format: str
    bytes: int
    train_psnr: float
    test_psnr: float | None


@dataclass(frozen=True)
class Compressed:
    """The result of ``compress``."""

    file: Path
    attempts: list[Attempt]

    @property
    def written(self) -> Attempt:
        """The attempt in the file."""
        return next(attempt for attempt in self.attempts if attempt.kind == "written")


@dataclass(frozen=True)
class Comparison:
    """The result of ``compare``: a summary, and files with tables, plots and pictures."""

    summary: str
    report: Path
    page: Path
    runs: list[dict[str, Any]] = field(repr=False)

    def __str__(self) -> str:
        return self.summary

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(self.summary)}</pre>"


def train(
    scene: Scene | None = None,
    *,
    policy: PolicyLike | None = None,
    output: StrPath | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: bool = True,
    on_step: Callable[[int, float, int], object] | None = None,
    on_record: Callable[[dict[str, Any]], object] | None = None,
    on_edit: Callable[[dict[str, Any]], object] | None = None,
    on_test: Callable[[int, dict[str, float]], object] | None = None,
    **options: Unpack[Options],
) -> Run:
    """Trains a scene and writes all files of the run, as ``densify train`` does.

    ``policy`` is a name (default: diet), or a class or an instance made with ``@densify.policy``. ``on_step`` gets
    step, loss and rows; ``on_record`` a record of every tenth step; ``on_edit`` each edit of the rows; ``on_test`` a
    step and the mean scores of the test views. Ctrl-C ends the run between two steps, with a checkpoint, and raises
    Interrupted; ``resume=True`` continues it.
    """
    _policy.check_not_importing()
    stop = _densify.Stop()
    listener = Listener(progress, on_step, on_record, on_edit, on_test)
    table = _table(scene, policy, output, options)
    with noting(stop):
        folder = _densify.train(table, resume=resume, overwrite=overwrite, listener=listener, stop=stop)
    return Run(folder, dataset=scene if isinstance(scene, Dataset) else None)


def prepare(
    scene: Scene,
    *,
    policy: PolicyLike | None = None,
    output: StrPath | None = None,
    progress: bool = False,
    **options: Unpack[Options],
) -> Trainer:
    """Prepares a run to step through; nothing is written."""
    _policy.check_not_importing()
    core = _densify.prepare(_table(scene, policy, output, options), listener=Listener(progress))
    return Trainer._of(core, scene if isinstance(scene, Dataset) else None)


def plan(
    scene: Scene, *, policy: PolicyLike | None = None, progress: bool = False, **options: Unpack[Options]
) -> MemoryPlan:
    """The memory that a run would take, without training, as ``densify plan`` prints it."""
    table = _table(scene, policy, None, options)
    buffers, total, lines, (memory, images, rows) = _densify.plan(table, listener=Listener(progress))
    ledger = [Buffer(*buffer) for buffer in buffers]
    return MemoryPlan(ledger, total, "\n".join(lines), memory, [scale for scale, _ in images], rows)


class Trainer:
    """A prepared run. ``for step in trainer`` trains it to its end."""

    _core: _densify.TrainerCore
    _stop: _densify.Stop
    _dataset: Dataset | None

    def __init__(self) -> None:
        raise TypeError("densify.prepare(…) makes trainers")

    @classmethod
    def _of(cls, core: _densify.TrainerCore, dataset: Dataset | None) -> Trainer:
        trainer = cls.__new__(cls)
        trainer._core, trainer._dataset, trainer._stop = core, dataset, _densify.Stop()
        return trainer

    def step(self) -> Step:
        """Does one iteration."""
        step, view, name, loss, l1, ssim, rows, events = self._core.step()
        return Step(step, view, name, loss, l1, ssim, rows, json.loads(events))

    def __iter__(self) -> Iterator[Step]:
        with noting(self._stop):
            while self.steps_done < self.iterations:
                if self._stop.asked:
                    raise Interrupted(f"stopped after step {self.steps_done}")
                yield self.step()

    def stop(self) -> None:
        """Ends the loop over this trainer before its next step; other threads may call it."""
        self._stop.ask()

    def finish(self, *, overwrite: bool = False, progress: bool = True) -> Run:
        """Trains to the end and writes all files of the run, as ``train`` does."""
        listener = Listener(progress)
        with noting(self._stop):
            folder = self._core.finish(overwrite=overwrite, listener=listener, stop=self._stop)
        return Run(folder, dataset=self._dataset)

    def model(self) -> Model:
        """The model in the dataset's own coordinates."""
        return Model._of(self._core.model())

    def render(self, camera: Camera, *, background: str | Sequence[float] = "black") -> Rendering:
        """Renders a camera in the dataset's own coordinates."""
        return Rendering(*self._core.render(camera._parts(), colour_of(background)))

    @property
    def steps_done(self) -> int:
        """Number of steps done."""
        return self._core.steps_done

    @property
    def iterations(self) -> int:
        """Length of the run in steps."""
        return self._core.last

    @property
    def rows(self) -> int:
        """Current number of Gaussians."""
        return self._core.rows

    @property
    def ledger(self) -> list[Buffer]:
        """The planned memory, buffer by buffer."""
        return [Buffer(*buffer) for buffer in self._core.ledger]

    @property
    def total_bytes(self) -> int:
        """The memory that the run promises not to exceed [bytes]."""
        return self._core.total_bytes

    @property
    def config(self) -> dict[str, Any]:
        """The options with every choice made."""
        config: dict[str, Any] = json.loads(self._core.config())
        return config

    def __repr__(self) -> str:
        return f"<densify.Trainer: step {self.steps_done} of {self.iterations}, {self.rows:,} Gaussians>"


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

    @cached_property
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
        path = self.folder / "results.json"
        if not path.is_file():
            return {}
        entries: dict[str, dict[str, float]] = json.loads(path.read_text("utf-8"))
        return max(entries.items(), key=lambda entry: int(entry[0].rpartition("_")[2]))[1]

    @property
    def curves(self) -> dict[str, NDArray[np.float64]]:
        """Columns of stats/train.jsonl: step, loss, l1, ssim, rows, seconds, …"""
        records = _records(self.folder / "stats" / "train.jsonl")
        names = records[0] if records else {}
        return {name: np.array([record.get(name) for record in records], dtype=float) for name in names}

    @property
    def events(self) -> list[dict[str, Any]]:
        """The edits of the rows, in order."""
        return _records(self.folder / "stats" / "events.jsonl")

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

    def report(self, path: StrPath | None = None, *, overwrite: bool = True) -> Path:
        """Writes the report on this run as one HTML file, by default report.html in its folder."""
        file = self.folder / "report.html" if path is None else Path(path)
        _densify.report(
            [fspath(self.folder)],
            fspath(file),
            "{}",
            iteration=None,
            overwrite=overwrite,
            listener=Listener(False),
        )
        return file

    @cached_property
    def _html(self) -> str:
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
            for view in _some(self, split, 3):
                parts.append(_picture(view))
        except Exception as error:  # A picture is not worth the cell: the dataset may have moved.
            parts.append(f"<p>no pictures: {html.escape(str(error))}</p>")
        return "".join(parts)

    def _repr_html_(self) -> str:
        return self._html


def _records(path: Path) -> list[dict[str, Any]]:
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
    pixels = np.ascontiguousarray(np.concatenate(both, axis=1))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "view.png"
        _densify.write_image(fspath(path), pixels)
        data = base64.b64encode(path.read_bytes()).decode()
    name = html.escape(view.name, quote=True)
    return f'<figure><img alt="{name}" src="data:image/png;base64,{data}"><figcaption>{name}</figcaption></figure>'


def _open(
    model: RunOrModel, scene: Scene | None, iteration: int | None, antialias: str | None, options: Mapping[str, Any]
) -> _densify.OpenedModel:
    return _densify.open_model(
        fspath(model),
        _table(scene, None, None, options),
        iteration=iteration,
        antialias=antialias,
        listener=Listener(False),
    )


def _some(model: RunOrModel, split: Split, count: int) -> Iterator[Rendering]:
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
    by_view = {
        name: {key: value for key, value in zip(names, values) if value is not None} for name, *values in views
    }
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
    core = _densify.ModelArrays.load(
        fspath(model), iteration=iteration, antialias=antialias, listener=listener
    )
    core.save(fspath(output), format=format, coordinates=coordinates, overwrite=overwrite, listener=listener)
    return Path(output)


def compress(
    model: RunOrModel,
    output: StrPath,
    *,
    to: int | str,
    scene: Scene | None = None,
    format: str | None = None,
    iterations: int = 3000,
    seed: int = 0,
    iteration: int | None = None,
    overwrite: bool = False,
    antialias: str | None = None,
    progress: bool = True,
    **options: Any,
) -> Compressed:
    """Reduces a model to ``to`` Gaussians, or its file to a size such as "5MiB", as ``densify compress`` does."""
    stop = _densify.Stop()
    rows, size = (to, None) if isinstance(to, int) else _densify.parse_target(to)
    with noting(stop):
        file, attempts = _densify.compress(
            fspath(model),
            fspath(output),
            _table(scene, None, None, options),
            to_rows=rows,
            to_bytes=size,
            format=format,
            iterations=iterations,
            seed=seed,
            iteration=iteration,
            overwrite=overwrite,
            antialias=antialias,
            listener=Listener(progress),
            stop=stop,
        )
    return Compressed(Path(file), [Attempt(*attempt) for attempt in attempts])


def scenegen(
    source: StrPath, output: StrPath, *, overwrite: bool = False, progress: bool = False, **options: Any
) -> Path:
    """Ray-traces a mesh (.gltf, .glb, .obj) or a built-in scene ("scene:room") into posed images.

    Options are those of a scene: rig, train, test, size=(width, height), fov, grid, seed, points={"count": …}, …
    """
    _densify.scenegen(
        fspath(source), fspath(output), plain(options), overwrite=overwrite, listener=Listener(progress)
    )
    return Path(output)


def compare(
    scenes: Scene | Sequence[Scene],
    policies: Sequence[PolicyLike],
    *,
    budget: int | Sequence[int] | Mapping[str, int],
    seeds: int = 3,
    iterations: int = 7000,
    output: StrPath = "comparison",
    progress: bool = True,
    **options: Any,
) -> Comparison:
    """Trains a scene with several policies under the same conditions, and says which did best.

    Each run is a process of its own, so classes must be in a file; write one with ``%%writefile`` in a notebook. An
    interrupted comparison continues when it is called again.
    """
    _policy.check_not_importing()
    table: dict[str, Any] = dict(options)
    files = [str(known) for known in table.get("policy_file") or ()]
    names = []
    for policy in policies:
        name, settings, file = _policy.name_and_settings(policy)
        if not isinstance(policy, str):
            if file is None:
                raise InputError(
                    f"policy `{name}` is not in a file, so other processes cannot import it;"
                    " write it to one (%%writefile in a notebook)"
                )
            if file not in files:
                files.append(file)
        words = [f"{key}={str(value).lower() if isinstance(value, bool) else value}" for key, value in settings.items()]
        names.append(":".join([name, *words]))
    if files:
        table["policy_file"] = files
    single = isinstance(scenes, str) or hasattr(scenes, "__fspath__")
    all_scenes = cast("Sequence[Scene]", [scenes] if single else scenes)
    budgets: list[tuple[str | None, int]]
    if isinstance(budget, Mapping):
        budgets = list(budget.items())
    else:
        budgets = [(None, rows) for rows in ([budget] if isinstance(budget, int) else budget)]
    stop = _densify.Stop()
    with noting(stop):
        summary, report = _densify.compare(
            [fspath(scene) for scene in all_scenes],
            names,
            budgets,
            plain(table),
            seeds=seeds,
            iterations=iterations,
            output=fspath(output),
            listener=Listener(progress),
            stop=stop,
        )
    path = Path(report)
    return Comparison(summary, path, path.with_suffix(".html"), _records(path.with_suffix(".jsonl")))


class Page:
    """A page in the browser with a model; it lasts until ``close`` or the end of the program."""

    def __init__(self, core: _densify.PageCore) -> None:
        self._core = core

    @property
    def url(self) -> str:
        """The page's address, for browsers on this machine."""
        return self._core.url

    def close(self) -> None:
        """Ends the page."""
        self._core.close()

    def __enter__(self) -> Page:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<densify.Page {self.url}>"

    def _repr_html_(self) -> str:
        url = html.escape(self.url, quote=True)
        return f'<a href="{url}">{url}</a><br><iframe src="{url}" width="100%" height="600"></iframe>'


def view(
    model: RunOrModel,
    other: RunOrModel | None = None,
    *,
    scene: Scene | None = None,
    iteration: int | None = None,
    port: int | None = None,
    **options: Any,
) -> Page:
    """Serves a page with a run, a model or a dataset, as ``densify view`` does."""
    core = _densify.serve(
        fspath(model),
        None if other is None else fspath(other),
        _table(scene, None, None, options),
        iteration=iteration,
        port=port,
        listener=Listener(False),
    )
    return Page(core)
