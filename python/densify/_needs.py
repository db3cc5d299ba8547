"""What a policy declares: the signals that it reads, and its changes to initialisation and training."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from . import _densify
from ._names import Column, Signal


@dataclass(frozen=True)
class LossTerms:
    """Coefficients of terms added to the loss: the mean opacity, and the mean standard deviation."""

    opacity: float = 0.0
    scale: float = 0.0


@dataclass(frozen=True)
class NoiseTerm:
    """Noise on the means after each optimiser step, as in 3DGS-MCMC."""

    strength: float
    sharpness: float
    opacity: float


@dataclass(frozen=True)
class MaskTerm:
    """A learned mask per row, as in Compact 3D Gaussian Representation."""

    start: float
    rate: float
    weight: float
    threshold: float


@dataclass(frozen=True)
class Cadence:
    """Iterations per optimiser step: for all parameters, and for spherical-harmonic bands 1–3."""

    all: int = 1
    sh_rest: int = 1


@dataclass(frozen=True)
class Rate:
    """A learning rate, which changes log-linearly over the run."""

    start: float
    end: float


@dataclass(frozen=True)
class Fade:
    """A factor on the rates of opacities and colours that falls from 1 to ``to`` after the share ``from_`` of the run."""

    from_: float
    to: float


@dataclass(frozen=True)
class Rates:
    """Learning rates that replace the trainer's defaults; None: the trainer's."""

    mean: Rate | None = None
    log_scale: Rate | None = None
    quat: Rate | None = None
    opacity: Rate | None = None
    sh_dc: Rate | None = None
    sh_rest: Rate | None = None
    fade: Fade | None = None


@dataclass(frozen=True)
class Start:
    """Changes to the initial rows: their opacity, and a factor on their standard deviations."""

    opacity: float | None = None
    scale: float = 1.0


@dataclass(frozen=True)
class ErrorScore:
    """How pixel errors are summed into the signal ``error_score``."""

    map: Literal["loss", "l1", "dssim"] = "loss"
    power: float = 1.0
    edge: float = 0.0
    footprint: float = 0.0
    view_power: float = 1.0


@dataclass(frozen=True)
class Candidates:
    """Pixels of the training views to collect as candidates for new rows."""

    from_: int
    until: int
    rows_per_candidate: int
    capacity: int
    error: Literal["grad", "l1", "l1-dssim"] = "l1"
    depth: Literal["max-weight", "median"] = "max-weight"
    min_alpha: float = 0.0
    spaced: bool = False


@dataclass(frozen=True)
class PixelMap:
    """Weights of error and edges in the map that the column ``map_sum`` sums.

    ``threshold``: with a value above 0, a pixel counts as 1 if its error, scaled to 0..1, is above it, and else as 0.
    """

    error: float = 0.0
    edge: float = 0.0
    threshold: float = 0.0


@dataclass(frozen=True)
class Aux:
    """Measurements in auxiliary views, which ``observe`` receives.

    ``margin``: distance from the surface, as a fraction of its depth, from which ``weight_in_front`` counts a row.
    """

    columns: Sequence[Column] = ()
    map: PixelMap = field(default_factory=PixelMap)
    points: int = 0
    margin: float = 0.05


@dataclass(frozen=True)
class SignalInfo:
    """A signal: a statistic of each row.

    It has ``width`` numbers per row. If ``is_resettable``, it accumulates over views until a plan resets it.
    """

    name: str
    unit: str
    width: int
    is_resettable: bool
    meaning: str


def signals() -> list[SignalInfo]:
    """All signals that a policy can declare, with their meaning."""
    found = []
    for name, unit, width, is_resettable, meaning in _densify.signals():
        plain = re.sub(r"\[`?([^\]`]+)`?\]\(([^)]*)\)|\[`([A-Z_a-z:]+)`\]", _linked, meaning)
        found.append(SignalInfo(name, unit, width, is_resettable, " ".join(plain.replace("`", "").split())))
    return found


def _linked(link: re.Match[str]) -> str:
    """The text of a link of Rust's documentation; signals have their Python names."""
    text, target, alone = link.groups()
    if target is not None and target.startswith("Self::"):
        return re.sub(r"(?<=[a-z])([A-Z])", r"_\1", text).lower()
    return (text or alone).replace("::", ".")


@dataclass(frozen=True)
class Needs:
    """The inputs of a policy, and its changes to initialisation and training. Only these are computed.

    ``signals()`` explains the signals.
    ``scratch_bytes`` is memory per row that the policy takes at an event beyond 32 bytes; the run's memory includes it.
    """

    signals: Sequence[Signal] = ()
    full_depth: float = 0.0
    error_score: ErrorScore | None = None
    candidates: Candidates | None = None
    aux: Aux | None = None
    pixel_loss: Literal["l1", "huber"] = "l1"
    loss_terms: LossTerms | None = None
    noise: NoiseTerm | None = None
    mask: MaskTerm | None = None
    cadence: Cadence | None = None
    least_resolution: float | None = None
    rates: Rates | None = None
    start: Start | None = None
    detailed_edits: bool = False
    scratch_bytes: int = 0
