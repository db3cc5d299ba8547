"""Policies that tests make from functions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import densify

from .conftest import SMALL

EXAMPLES = Path(__file__).parents[1] / "examples"
MANUAL = """# test

| name | default | range | unit | meaning |
|---|---|---|---|---|
| every | 10 | >= 1 | steps | interval |
"""


def make(name: str, plan: Any, signals: Any = ("opacity",), **more: Any) -> type:
    """Registers a policy whose plan is a function of now, rng and plan."""
    needs = densify.Needs(signals=signals, **more.pop("needs", {}))
    members = {
        "__doc__": MANUAL.replace("10", str(more.get("every", 10))),
        "__annotations__": {"every": int, **{key: int for key in more if not callable(more[key])}},
        "__module__": __name__,
        "every": 10,
        "needs": lambda self, scene: needs,
        "is_due": lambda self, step: step % self.every == 0,
        "plan": plan if plan.__code__.co_argcount == 4 else lambda self, *event: plan(*event),
        **more,
    }
    return densify.policy(name, summary="a test", source="a test")(type(name, (), members))


def train(scene: Path, policy: Any, folder: Path, **options: Any) -> densify.Run:
    return densify.train(scene, policy=policy, output=folder, progress=False, **{**SMALL, **options})


def fails(scene: Path, plan: Any, folder: Path, **more: Any) -> densify.PolicyError:
    with pytest.raises(densify.PolicyError) as raised:
        train(scene, make(f"p{abs(hash(folder))}", plan, **more), folder)
    # The run keeps its model, and its message says where the policy has failed.
    assert (folder / "point_cloud").is_dir() and "/python/tests/" in str(raised.value)
    return raised.value
