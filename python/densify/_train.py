"""Training: whole runs, and trainers that are stepped."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from . import _densify, _policy
from ._errors import DensifyError, Interrupted
from ._progress import Listener
from ._run import Run
from ._scenes import Camera, Dataset, Model, Rendering, StrPath, colour_of
from ._settings import PolicyLike, Scene, table_of
from ._signals import noting

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from ._options import Options


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

    ledger: list[Buffer] = field(repr=False)
    total_bytes: int
    text: str = field(repr=False)
    #: Rows that fit ``memory`` at each degree, for each resolution in ``resolutions``.
    memory: int
    resolutions: list[int]
    rows: list[list[int | None]]

    def __str__(self) -> str:
        return self.text


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

    Options are those of ``densify train --help``, with underscores: ``resolution=4, budget="200k", eval=True``.

    ``policy`` is a name (default: diet), or a class or an instance made with ``@densify.policy``. ``on_step`` gets
    step, loss and rows; ``on_record`` a record of every tenth step; ``on_edit`` each edit of the rows; ``on_test`` a
    step and the mean scores of the test views. Ctrl-C ends the run between two steps, with a checkpoint, and raises
    Interrupted; ``resume=True`` continues it.
    """
    _policy.check_not_importing()
    stop = _densify.Stop()
    listener = Listener(progress, on_step, on_record, on_edit, on_test)
    table = table_of(scene, policy, output, options)
    with noting(stop):
        folder = _densify.train(table, resume=resume, overwrite=overwrite, listener=listener, stop=stop)
    return Run(folder, dataset=scene if isinstance(scene, Dataset) else None)


def prepare(
    scene: Scene | None = None,
    *,
    policy: PolicyLike | None = None,
    output: StrPath | None = None,
    resume: bool = False,
    progress: bool = False,
    **options: Unpack[Options],
) -> Trainer:
    """Prepares a run to step through. Nothing is written before ``save_checkpoint`` or ``finish``.

    ``resume=True`` continues the run in ``output`` from its last checkpoint. ``progress`` prints how the run is prepared.
    """
    _policy.check_not_importing()
    table = table_of(scene, policy, output, options)
    core = _densify.prepare(table, resume=resume, listener=Listener(progress))
    return Trainer._of(core, scene if isinstance(scene, Dataset) else None, output is not None)


def plan(
    scene: Scene, *, policy: PolicyLike | None = None, progress: bool = False, **options: Unpack[Options]
) -> MemoryPlan:
    """The memory that a run would take, without training, as ``densify plan`` prints it."""
    table = table_of(scene, policy, None, options)
    buffers, total, lines, (memory, images, rows) = _densify.plan(table, listener=Listener(progress))
    ledger = [Buffer(*buffer) for buffer in buffers]
    return MemoryPlan(ledger, total, "\n".join(lines), memory, [scale for scale, _ in images], rows)


class Trainer:
    """A prepared run. ``for step in trainer`` trains it to its end.

    Ctrl-C raises Interrupted between two steps; if ``output`` was given, it writes a checkpoint first. The loop can be
    entered again.
    """

    _core: _densify.TrainerCore
    _stop: _densify.Stop
    _dataset: Dataset | None
    _has_output: bool

    def __init__(self) -> None:
        raise TypeError("densify.prepare(…) makes trainers")

    @classmethod
    def _of(cls, core: _densify.TrainerCore, dataset: Dataset | None, has_output: bool) -> Trainer:
        trainer = cls.__new__(cls)
        trainer._core, trainer._dataset, trainer._has_output = core, dataset, has_output
        trainer._stop = _densify.Stop()
        return trainer

    def step(self) -> Step:
        """Does one iteration. Ctrl-C raises Interrupted after it."""
        with noting(self._stop):
            step, view, name, loss, l1, ssim, rows, events = self._core.step()
        if self._stop.by_signal:
            self._interrupt()
        return Step(step, view, name, loss, l1, ssim, rows, json.loads(events))

    def __iter__(self) -> Iterator[Step]:
        while self.steps_done < self.iterations:
            if self._stop.asked:
                self._interrupt()
            yield self.step()

    def _interrupt(self) -> NoReturn:
        by_signal = self._stop.by_signal
        self._stop.clear()
        message = f"stopped after step {self.steps_done}"
        if by_signal and self._has_output:
            try:
                message += f"; resume=True continues from the checkpoint in {self.save_checkpoint()}"
            except DensifyError as error:
                message += f"; no checkpoint was written: {error}"
        raise Interrupted(message)

    def stop(self) -> None:
        """Ends the loop over this trainer with Interrupted before its next step; other threads may call it."""
        self._stop.ask()

    def save_checkpoint(self) -> Path:
        """Writes a checkpoint into the output folder, which is returned; training can go on here.

        ``prepare(output=…, resume=True)``, ``train(output=…, resume=True)`` and ``densify train --resume`` continue from
        it, and end with the same bytes.
        """
        return Path(self._core.save_checkpoint())

    def finish(self, *, overwrite: bool = False, progress: bool = True) -> Run:
        """Trains to the end and writes all files of the run, as ``train`` does."""
        listener = Listener(progress)
        try:
            with noting(self._stop):
                folder = self._core.finish(overwrite=overwrite, listener=listener, stop=self._stop)
        except Interrupted:
            self._stop.clear()
            raise
        return Run(folder, dataset=self._dataset)

    def model(self) -> Model:
        """The model in the dataset's own coordinates."""
        return Model._of(self._core.model())

    def render(self, camera: Camera, *, background: str | Sequence[float] = "black") -> Rendering:
        """Renders a camera in the dataset's own coordinates, no larger than the training views.

        Larger ones take more memory than the run promises: ``trainer.model().render(camera)`` renders them.
        """
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
