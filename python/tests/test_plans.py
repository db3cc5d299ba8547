"""Edits of plans: wrong ones are exceptions, and refused ones are counted."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import densify

from .made import fails, make, train


@pytest.mark.parametrize(
    ("edit", "error", "message"),
    [
        (lambda plan: plan.prune([-1]), IndexError, "no row -1"),
        (lambda plan: plan.prune(np.array([2**63], dtype=np.uint64)), IndexError, "no row"),
        (lambda plan: plan.prune([0, 10_000]), IndexError, "no row 10000"),
        (lambda plan: plan.prune([0.5]), TypeError, "integers or a mask"),
        (lambda plan: plan.prune("no"), TypeError, "dimension|integers"),
        (lambda plan: plan.prune([[0]]), TypeError, "one dimension"),
        (lambda plan: plan.prune([True, False]), ValueError, "the mask has 2 entries"),
        (lambda plan: plan.grow([0], densify.split(float("nan"))), ValueError, "`scale` is not finite"),
        (lambda plan: plan.grow([0], densify.clone(float("nan"))), ValueError, "3 numbers"),
        (lambda plan: plan.grow([0], densify.Offspring(children=0)), ValueError, "children"),
        (lambda plan: plan.grow([0, 1], densify.Offspring(children=[1, 1, 1])), ValueError, "each of 2"),
        (lambda plan: plan.grow([0], 1.6), TypeError, "densify.split"),
        (lambda plan: plan.grow([0], densify.Offspring(opacity="more")), ValueError, "conserved"),
        (lambda plan: plan.grow([0], densify.Offspring(opacity=0.5)), TypeError, "densify.by"),
        (lambda plan: plan.grow([0], densify.Offspring(turn=[1.0, 0.1, 0.0, 0.0])), densify.Undeclared, "detailed"),
        (lambda plan: plan.update([0], colour=[0.1, 0.2, 0.3]), densify.Undeclared, "detailed_edits"),
        (lambda plan: plan.append([[0.0, 0.0, np.nan]], [0.5] * 3, 0.1, 0.5), ValueError, "position"),
        (lambda plan: plan.append([0.0, 0.0, 0.0], [0.5] * 3, 0.1, 0.5), ValueError, "shape"),
        (lambda plan: plan.append([["a", "b", "c"]], [0.5] * 3, 0.1, 0.5), TypeError, "numbers"),
        (lambda plan: plan.append([[0j, 0j, 0j]], [0.5] * 3, 0.1, 0.5), TypeError, "numbers"),
        (lambda plan: plan.grow([0], densify.Offspring(scale=densify.by([1.0, 0.5, 0.2]))), ValueError, "three axes"),
        (lambda plan: plan.append([[0.0] * 3] * 2, [0.5] * 3, [0.1, 0.2, 0.3], 0.5), ValueError, r"\[2, 3\]"),
        (lambda plan: plan.clamp_opacity(1.5), ValueError, "max"),
        (lambda plan: plan.decay(opacity=-1.0), ValueError, "opacity"),
        (lambda plan: plan.decay(seen_only=True), densify.Undeclared, "visible_count"),
        (lambda plan: plan.reset("all"), ValueError, "signals, candidates"),
        (lambda plan: plan.reset(["opaciti"]), ValueError, "opaciti"),
    ],
)
def test_wrong_edits_are_exceptions(
    scene: Path, tmp_path: Path, edit: Any, error: type[Exception], message: str
) -> None:
    def plan(now: densify.Now, rng: densify.Rng, plan: densify.Plan) -> None:
        with pytest.raises(error, match=message):
            edit(plan)
        edit(plan)

    raised = fails(scene, plan, tmp_path / "run")
    assert isinstance(raised.__cause__, error) and "step 10" in str(raised)


def test_refused_edits_are_false_and_counted(scene: Path, tmp_path: Path) -> None:
    seen: dict[str, Any] = {}

    def plan(now: densify.Now, rng: densify.Rng, plan: densify.Plan) -> None:
        seen["twice"] = plan.prune([0, 1, 1]).tolist()
        seen["taken"] = plan.grow(np.array([1, 2], dtype=np.int8), densify.clone()).tolist()
        mask = np.zeros(now.rows, bool)
        mask[3:5] = True
        seen["mask"] = plan.grow(mask, densify.split(np.array([1.5, 2.0]), opacity="conserved")).tolist()
        seen["room"] = plan.room
        seen["beyond"] = int(plan.append(np.zeros((400, 3)), [0.5] * 3, 0.1, 0.5).sum())
        seen["free"] = int(plan.free.sum())

    run = train(scene, make("refused_edits", plan, every=60), tmp_path / "run", budget=250)
    assert seen["twice"] == [True, True, False] and seen["taken"] == [False, True]
    assert seen["mask"] == [True, True] and seen["room"] == seen["beyond"] == 49 and seen["free"] == 195
    (event,) = run.events
    assert (event["before"], event["after"], event["denied"]) == (200, 250, 353)


def test_detailed_edits(scene: Path, tmp_path: Path) -> None:
    def plan(now: densify.Now, rng: densify.Rng, plan: densify.Plan) -> None:
        rows = np.arange(4)
        assert plan.update(rows, opacity=densify.to([0.1, 0.2, 0.3, 0.4]), scale=densify.to(0.2)).all()
        assert plan.update([4], position=[0.0, 0.1, 0.2], colour=[0.1, 0.2, 0.3], keep_moments=False).all()
        turned = densify.Offspring(children=[1, 2], scale=densify.by([[1.0, 0.5, 0.25]] * 2), turn=[0.0, 1.0, 0.0, 0.0])
        assert plan.grow([6, 7], turned).all()
        assert plan.grow([8], densify.split_long_axis(0.45, 0.6)).all()
        # Three factors are one per row, and three columns are the axes, also for three rows.
        for rows, factors in (([10, 11, 12], [0.5, 0.6, 0.7]), ([13, 14, 15], [[1.0, 0.5, 0.25]])):
            assert plan.update(rows, scale=densify.by(factors)).all()
        assert plan.append([[0.0, 0.0, 0.0]], [0.5, 0.5, 0.5], [[0.1, 0.2, 0.3]], 0.5, [1.0, 0.0, 0.0, 0.0]).all()

    policy = make("detailed", plan, needs={"detailed_edits": True}, every=60)
    (event,) = train(scene, policy, tmp_path / "run").events
    assert (event["added"], event["updated"]) == (5, 12)
