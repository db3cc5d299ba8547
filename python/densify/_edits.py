"""Edits of a plan as data: children, and rules for scales, opacities and places."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from numpy.typing import ArrayLike


@dataclass(frozen=True)
class Rule:
    """A change of scales or opacities, or the place of children; made by ``by``, ``to``, ``long_axis``, …

    Numbers are for all rows, or an array of one per row.
    """

    kind: str
    value: ArrayLike
    other: ArrayLike = 1.0


def by(factor: ArrayLike) -> Rule:
    """Multiplies scales (or each axis, with the shape [1, 3] or [rows, 3]) or opacities (in (0, 1])."""
    return Rule("by", factor)


def to(value: ArrayLike) -> Rule:
    """Sets the opacity, in (0, 1), or all three standard deviations [scene units], > 0."""
    return Rule("to", value)


def long_axis(long: ArrayLike, other: ArrayLike) -> Rule:
    """Multiplies the scale of the longest axis by ``long``, those of the others by ``other``."""
    return Rule("long_axis", long, other)


def offset(position: ArrayLike) -> Rule:
    """Children at the parent's mean plus this offset [scene units]."""
    return Rule("offset", position)


def along(sigmas: ArrayLike) -> Rule:
    """Children at ± this many standard deviations along the parent's longest axis."""
    return Rule("long_axis", sigmas)


def axes(sigmas: ArrayLike) -> Rule:
    """Children at ± these numbers of standard deviations along the parent's three axes."""
    return Rule("axes", sigmas)


Opacity = Rule | Literal["same", "conserved"]


@dataclass(frozen=True)
class Offspring:
    """The children of rows that grow.

    ``children`` are new rows besides the parent's own slot. The parent stays, or is rewritten as one more child.
    ``scale`` and ``turn`` (a quaternion w, x, y, z about the parent's axes) are relative to the parent. An opacity that
    is "conserved" makes the children together as opaque as the parent was.
    """

    children: ArrayLike = 1
    parent: Literal["stays", "becomes_child"] = "stays"
    placement: Rule | Literal["sampled"] = Rule("offset", (0.0, 0.0, 0.0))
    scale: Rule | ArrayLike = 1.0
    turn: ArrayLike | None = None
    opacity: Opacity = "same"


def clone(offset: ArrayLike = (0.0, 0.0, 0.0)) -> Offspring:
    """The parent stays, and a copy is placed at ``offset`` from it [scene units]."""
    return Offspring(placement=Rule("offset", offset))


def split(factor: ArrayLike, *, opacity: Opacity = "same") -> Offspring:
    """Two children, sampled from the parent and smaller by ``factor``, replace it."""
    import numpy as np

    smaller = np.float32(1.0) / np.asarray(factor, dtype=np.float32)
    return Offspring(parent="becomes_child", placement="sampled", scale=by(smaller), opacity=opacity)


def split_long_axis(share: float, opacity: float = 1.0) -> Offspring:
    """Two halves along the longest axis replace the parent, whose ends stay in place; ``share`` is in [0, 1)."""
    scale = long_axis(1.0 - share, (1.0 - share * share) ** 0.5)
    return Offspring(parent="becomes_child", placement=along(3.0 * share), scale=scale, opacity=by(opacity))
