"""Arguments of functions as the options of a run."""

from __future__ import annotations

from collections.abc import Mapping
from os import fspath
from typing import Any, Literal, TypeAlias

from . import _policy
from ._scenes import StrPath, plain

Split = Literal["train", "test"]
#: A folder, an archive, scene:NAME, or a densify.Dataset.
Scene: TypeAlias = StrPath
#: A densify.Run, the folder of a run, or a model file.
RunOrModel: TypeAlias = StrPath
#: A policy by name, or a class or an instance made with @densify.policy.
PolicyLike: TypeAlias = str | object


def table_of(scene: Scene | None, policy: PolicyLike | None, output: StrPath | None, options: Mapping[str, Any]) -> str:
    """The options of a run as JSON."""
    table = dict(options)
    if scene is not None:
        table["scene"] = fspath(scene)
    if output is not None:
        table["output"] = fspath(output)
    _policy.load_installed()
    files = _policy.files_of(table)
    if policy is not None:
        name, settings, file = _policy.name_and_settings(policy)
        table["policy"] = name
        if settings:
            given = dict(table.get("policy_set") or {})
            given[name] = {**settings, **given.get(name, {})}
            table["policy_set"] = given
        if file is not None and file not in files:
            files.append(file)
    if files:
        table["policy_file"] = files
    return plain(table)
