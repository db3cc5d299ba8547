"""Compression, generated scenes, comparisons, and the page in the browser."""

from __future__ import annotations

import html
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from os import fspath
from pathlib import Path
from typing import Any, cast

from . import _densify, _policy
from ._progress import Listener
from ._run import read_records
from ._scenes import StrPath, plain
from ._settings import PolicyLike, RunOrModel, Scene, table_of
from ._signals import noting

# A limit for all scenes, several, or one per scene.
Limits = int | str | Sequence[int | str] | Mapping[str, int | str]


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
        page = html.escape(str(self.page))
        return f"<pre>{html.escape(self.summary)}</pre><p>with pictures: {page}</p>"


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
            table_of(scene, None, None, options),
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
    _densify.scenegen(fspath(source), fspath(output), plain(options), overwrite=overwrite, listener=Listener(progress))
    return Path(output)


def compare(
    scenes: Scene | Sequence[Scene],
    policies: Sequence[PolicyLike],
    *,
    budget: Limits = (),
    memory: Limits = (),
    seeds: int = 3,
    until_decided: str | None = None,
    max_seeds: int = 12,
    hours: float | None = None,
    iterations: int = 7000,
    output: StrPath = "comparison",
    progress: bool = True,
    **options: Any,
) -> Comparison:
    """Trains a scene with several policies under the same conditions, and says which did best.

    Runs are limited to a budget of Gaussians, or to a memory; ``{"room": "28k"}`` is for single scenes. With
    ``until_decided="scenes"`` or ``"mean"``, seeds are added, up to ``max_seeds``, until a sequential test decides.
    ``hours`` starts only what is expected to end within them; call again for the rest.

    Each run is a process of its own, so classes must be in a file; write one with ``%%writefile`` in a notebook. An
    interrupted comparison continues when it is called again.
    """
    _policy.check_not_importing()
    table: dict[str, Any] = dict(options)
    files = _policy.files_of(table)
    names = []
    for policy in policies:
        name, settings, file = _policy.name_and_settings(policy)
        if isinstance(policy, str):
            file = _policy.file_of_name(name.partition(":")[0])
        elif file is None:
            raise _policy.not_in_a_file(name)
        if file is not None and file not in files:
            files.append(file)
        words = [f"{key}={str(value).lower() if isinstance(value, bool) else value}" for key, value in settings.items()]
        names.append(":".join([name, *words]))
    if files:
        table["policy_file"] = files
    single = isinstance(scenes, str) or hasattr(scenes, "__fspath__")
    all_scenes = cast("Sequence[Scene]", [scenes] if single else scenes)
    stop = _densify.Stop()
    with noting(stop):
        summary, report = _densify.compare(
            [fspath(scene) for scene in all_scenes],
            names,
            _limits_of(budget, _densify.parse_rows),
            _limits_of(memory, _densify.parse_bytes),
            plain(table),
            seeds=seeds,
            until_decided=until_decided,
            max_seeds=max_seeds,
            hours=hours,
            iterations=iterations,
            output=fspath(output),
            listener=Listener(progress),
            stop=stop,
        )
    path = Path(report)
    return Comparison(summary, path, path.with_suffix(".html"), read_records(path.with_suffix(".jsonl")))


def _limits_of(given: Limits, parse: Callable[[str], int]) -> list[tuple[str | None, int]]:
    if isinstance(given, Mapping):
        return [(scene, _number_of(limit, parse)) for scene, limit in given.items()]
    return [(None, _number_of(limit, parse)) for limit in ([given] if isinstance(given, (int, str)) else given)]


def _number_of(limit: int | str, parse: Callable[[str], int]) -> int:
    return parse(limit) if isinstance(limit, str) else limit


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
        table_of(scene, None, None, options),
        iteration=iteration,
        port=port,
        listener=Listener(False),
    )
    return Page(core)
