"""A plug-in for pytest: ``pytest --densify steady.py`` runs the conformance suite on the policies of a file."""

from __future__ import annotations

from typing import Any

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    """Adds the option."""
    parser.getgroup("densify").addoption(
        "--densify",
        action="append",
        default=[],
        metavar="FILE|MODULE|NAME",
        help="run densify's conformance suite on the policies of a Python file or module, or on one by name",
    )


class ConformanceItem(pytest.Item):
    """The conformance suite on one policy."""

    def __init__(self, *, policy: str, **more: Any) -> None:
        super().__init__(**more)
        self.policy = policy

    def runtest(self) -> None:
        """Raises DensifyError with a report of all checks that failed."""
        from densify import check_policy

        check_policy(self.policy)

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException], style: Any = None) -> str:
        """The report, without a traceback of this package."""
        return str(excinfo.value)

    def reportinfo(self) -> tuple[str, None, str]:
        """The name in pytest's output."""
        return "densify", None, f"conformance of {self.policy}"


def policies_of(given: str) -> list[str]:
    """The policies of a file or a module, or the one of this name."""
    import sys
    from pathlib import Path

    import densify

    before = {info.name for info in densify.policies()}
    if given in before:
        return [given]
    densify.import_policies(given)
    module = sys.modules.get(given)
    file = str(Path(getattr(module, "__file__", None) or given).resolve())
    found = [info.name for info in densify.policies() if info.name not in before or info.place.startswith(f"{file}:")]
    if not found:
        raise pytest.UsageError(f"--densify {given}: it registers no policy")
    return found


def pytest_collection_modifyitems(session: pytest.Session, config: pytest.Config, items: list[pytest.Item]) -> None:
    """Adds the conformance suites to the tests."""
    for given in config.getoption("--densify"):
        try:
            names = policies_of(given)
        except (ImportError, OSError) as error:
            raise pytest.UsageError(f"--densify {given}: {error}") from None
        for name in names:
            items.append(ConformanceItem.from_parent(session, name=f"densify[{name}]", policy=name))
