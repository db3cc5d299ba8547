"""Policies written in Python: the decorator, and the part of the bridge to Rust that is Python."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib
import importlib.util
import inspect
import json
import math
import platform
import sys
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from os import PathLike, fspath
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar, cast

import numpy as np

from . import _densify, _needs
from ._errors import InputError

if TYPE_CHECKING:
    from typing_extensions import dataclass_transform
else:

    def dataclass_transform(**_):
        return lambda function: function


#: Name of the class attribute that a registered class has.
MARK = "__densify_policy__"
#: Group of entry points of installed policies.
ENTRY_POINTS = "densify.policies"
_SCALES = "densify_scales"
_STATE = "densify_state"

T = TypeVar("T")
_importing = 0
_installed = False
_installing = False


@dataclass(frozen=True)
class PolicyInfo:
    """A policy: ``parameters`` maps names to defaults as TOML."""

    name: str
    summary: str
    source: str
    place: str
    manual: str = field(repr=False)
    parameters: dict[str, str] = field(repr=False)


@dataclass(frozen=True)
class _Registered:
    name: str
    file: str | None


#: Policies by name that other processes do not find by themselves, unlike those of installed packages.
_of_this_program: dict[str, _Registered] = {}


def files_of(options: Mapping[str, Any]) -> list[str]:
    """The option ``policy_file``: files or modules, or a single one."""
    given = options.get("policy_file") or ()
    return [fspath(file) for file in ([given] if isinstance(given, (str, PathLike)) else given)]


def interval(default: int) -> int:
    """A parameter: steps between two events. It scales with the length of the run, but not below 100."""
    return dataclasses.field(default=default, metadata={_SCALES: "interval"})


def step(default: int) -> int:
    """A parameter: a step of the run, or a number of steps. It scales with the length of the run."""
    return dataclasses.field(default=default, metadata={_SCALES: "step"})


def state(default: T, *, init: Literal[False] = False) -> T:
    """A part of the policy's state: JSON values, which checkpoints save. It is not a parameter."""
    text = json.dumps(default, allow_nan=False)
    return cast(T, dataclasses.field(init=init, default_factory=lambda: json.loads(text), metadata={_STATE: True}))


@dataclass_transform(field_specifiers=(interval, step, state))
def policy(name: str, *, summary: str, source: str) -> Callable[[type[T]], type[T]]:
    """Registers a class as a policy. Its docstring is the manual page, with a table of all parameters."""

    def register(cls: type[T]) -> type[T]:
        if not isinstance(cls, type):
            raise TypeError("@densify.policy(…) is for a class")
        # `dataclass` invents a docstring, and -OO strips it.
        manual = cls.__dict__.get("__doc__")
        if not manual:
            raise ValueError(
                f"policy `{name}`: the class has no docstring, which is its manual page"
                " (python -OO strips docstrings: start Python without it)"
            )
        for method in ("needs", "is_due", "plan"):
            if not callable(getattr(cls, method, None)):
                raise TypeError(f"policy `{name}`: the class has no method `{method}`")
        made = cls if "__dataclass_fields__" in vars(cls) else dataclass(cls)
        _describe(made, name, summary, source, inspect.cleandoc(manual))
        return made

    return register


def _describe(cls: type[Any], name: str, summary: str, source: str, manual: str) -> None:
    table = _table(manual)
    fields = dataclasses.fields(cls)
    states = frozenset(field.name for field in fields if field.metadata.get(_STATE))
    parameters = []
    for field in fields:
        if field.name in states:
            continue
        if field.default is dataclasses.MISSING:
            raise TypeError(f"policy `{name}`: parameter `{field.name}` has no default")
        row = table.pop(field.name, None)
        if row is None:
            raise ValueError(
                f"policy `{name}`: the docstring has no row for the parameter `{field.name}`, such as"
                f" `| {field.name} | {field.default} | >= 0 | | … |`"
            )
        parameters.append((field.name, field.default, field.metadata.get(_SCALES, ""), row[1]))
        _check_default(name, field, row[0])
    for unknown in table:
        raise ValueError(f"policy `{name}`: the docstring's `{unknown}` is not a parameter")
    _protect(cls, name, states)
    file = _file_of(cls)
    try:
        line = inspect.getsourcelines(cls)[1]
    except (OSError, TypeError):
        line = 0
    # A file may be imported under several names; a cell of a notebook has a new file each time.
    identity = f"{file or cls.__module__}:{cls.__qualname__}"
    shown = file or f"<{cls.__module__}>"
    about = (name, summary, source, manual)
    _densify.register(cls, about, (shown, line), (identity, _provenance(file)), parameters)
    registered = _Registered(name, file)
    setattr(cls, MARK, registered)
    if _installing:
        _of_this_program.pop(name, None)
    else:
        _of_this_program[name] = registered


def _provenance(file: str | None) -> str:
    """What a policy's decisions depend on besides densify; a resumed run notes differences."""
    versions = f"Python {platform.python_version()}, numpy {np.__version__}"
    if file is None:
        return versions
    path = Path(file)
    return f"{versions}, {path.name} with SHA-256 {hashlib.sha256(path.read_bytes()).hexdigest()[:16]}"


def _table(manual: str) -> dict[str, tuple[str, str]]:
    """Default and range of each row of the table of parameters."""
    lines = manual.splitlines()
    start = next((at for at, line in enumerate(lines) if line.startswith("| name | default |")), None)
    rows: dict[str, tuple[str, str]] = {}
    for line in lines[start + 2 :] if start is not None else []:
        if not line.startswith("|"):
            break
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        if len(cells) == 5:
            rows[cells[0]] = (cells[1], cells[2])
    return rows


def _check_default(name: str, field: dataclasses.Field[Any], written: str) -> None:
    default = field.default
    if isinstance(default, bool):
        same = written == str(default).lower()
    elif isinstance(default, (int, float)):
        try:
            same = float(written) == float(default)
        except ValueError:
            same = False
    else:
        same = written.strip('"') == str(default)
    if not same:
        raise ValueError(f"policy `{name}`: `{field.name}` has the default {default}, not {written}")


def _protect(cls: type[Any], name: str, states: frozenset[str]) -> None:
    """Records which parameters were given, and refuses other attributes than state after construction."""
    original = cls.__init__

    def init(self: Any, *args: Any, **kwargs: Any) -> None:
        given = inspect.signature(original).bind(self, *args, **kwargs).arguments
        object.__setattr__(self, "_given", tuple(list(given)[1:]))
        original(self, *args, **kwargs)
        object.__setattr__(self, "_ready", True)

    def set_attribute(self: Any, key: str, value: Any) -> None:
        if getattr(self, "_ready", False) and key not in states:
            raise AttributeError(
                f"policy `{name}`: `{key}` cannot be set: declare what is to last as"
                f" `{key}: … = densify.state(…)`, so that checkpoints save it"
            )
        object.__setattr__(self, key, value)

    init.__wrapped__ = original  # type: ignore[attr-defined]
    cls.__init__ = init
    cls.__setattr__ = set_attribute  # type: ignore[assignment]
    cls._states = states


def _file_of(cls: type[Any]) -> str | None:
    """The Python file that defines a class; None for a class of a notebook or a console."""
    module = sys.modules.get(cls.__module__)
    file = getattr(module, "__file__", None)
    return str(Path(file).resolve()) if file and file.endswith(".py") else None


# Called from Rust.


def call_quietly(method: Callable[..., object], *arguments: object) -> None:
    """Calls a method of a policy, for which NaN and infinities are ordinary values."""
    with np.errstate(all="ignore"):
        method(*arguments)


def needs_of(policy: Any, scene: _densify.Scene) -> str:
    """The needs of a policy as JSON."""
    needs = policy.needs(scene)
    if not isinstance(needs, _needs.Needs):
        raise TypeError(f"needs() must return densify.Needs(…), not {type(needs)}")
    return json.dumps(_as_json(needs), allow_nan=False)


def _as_json(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name.rstrip("_"): _as_json(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, str) or value is None:
        return value
    if isinstance(value, (list, tuple, set, frozenset)):
        return [_as_json(item) for item in value]
    return value.item() if isinstance(value, np.generic) else value


def numbers_of(answer: Any, class_name: str) -> list[float]:
    """The numbers of a declaration that a schedule returns."""
    expected = getattr(_needs, class_name)
    if not isinstance(answer, expected):
        raise TypeError(f"expected densify.{class_name}(…), not {type(answer)}")
    return [float(number) for number in dataclasses.astuple(answer)]


def state_of(policy: Any) -> str | None:
    """The state of a policy as JSON; None for a class without state.

    The attributes become what the JSON says, as after a resume: dicts in the order of their keys, lists that nothing
    else shares.
    """
    if not policy._states:
        return None
    values = {name: getattr(policy, name) for name in sorted(policy._states)}
    for name, value in values.items():
        _check_state(name, value)
    text = json.dumps(values, allow_nan=False, sort_keys=True)
    for name, value in json.loads(text).items():
        setattr(policy, name, value)
    return text


def _check_state(name: str, value: Any) -> None:
    if value is None or isinstance(value, (bool, str)):
        return
    if type(value) is int:
        if not -(2**63) <= value < 2**63:
            raise ValueError(f"state `{name}`: {value} does not fit 64 bits")
    elif type(value) is float:
        if not math.isfinite(value):
            raise ValueError(f"state `{name}`: {value} is not finite")
    elif type(value) is list:
        for item in value:
            _check_state(name, item)
    elif type(value) is dict:
        for key, item in value.items():
            if type(key) is not str:
                raise TypeError(f"state `{name}`: keys of a dict must be str, not {type(key)}")
            _check_state(name, item)
    else:
        raise TypeError(
            f"state `{name}`: {type(value)} cannot be saved; use numbers, str, list and dict (an array: array.tolist())"
        )


def restore_state(policy: Any, text: str) -> None:
    """Restores what ``state_of`` has returned."""
    values = json.loads(text)
    if not isinstance(values, dict) or set(values) != set(policy._states):
        raise ValueError(f"expected the values {', '.join(sorted(policy._states))}, found {text[:200]}")
    for name, value in values.items():
        setattr(policy, name, value)


def import_policies(file_or_module: str) -> None:
    """Imports a file or a module with policies, unless it has been imported."""
    global _importing
    _importing += 1
    try:
        if not file_or_module.endswith(".py"):
            importlib.import_module(file_or_module)
            return
        path = Path(file_or_module).resolve()
        for module in list(sys.modules.values()):
            file = getattr(module, "__file__", None)
            if file and file.endswith(".py") and Path(file).resolve() == path:
                return
        if not path.is_file():
            raise FileNotFoundError(f"there is no file {path}")
        name = f"densify_policy_{path.stem}_{hashlib.sha256(str(path).encode()).hexdigest()[:8]}"
        spec = importlib.util.spec_from_file_location(name, path)
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module
        try:
            spec.loader.exec_module(module)
        except BaseException:
            del sys.modules[name]
            raise
    finally:
        _importing -= 1


def check_not_importing() -> None:
    """Fails while a file with policies is imported: the run would start itself again and again."""
    if _importing:
        raise InputError(
            "this file starts a run when it is imported for its policies;"
            ' put the run under `if __name__ == "__main__":`'
        )


def load_installed() -> None:
    """Imports the policies of installed packages, once."""
    global _installed, _installing
    if _installed:
        return
    _installed = _installing = True
    try:
        for point in entry_points(group=ENTRY_POINTS):
            try:
                point.load()
            except Exception as error:
                warnings.warn(f"the policies of {point.value} cannot be imported: {error}", stacklevel=2)
    finally:
        _installing = False


def name_and_settings(policy: Any) -> tuple[str, dict[str, Any], str | None]:
    """The name of a policy, the parameters that were given to an instance, and the file of its class."""
    if isinstance(policy, str):
        load_installed()
        known = _of_this_program.get(policy)
        return policy, {}, None if known is None else known.file
    # A subclass is a policy of its own only if it is decorated itself.
    mark = vars(policy if isinstance(policy, type) else type(policy)).get(MARK)
    if not isinstance(mark, _Registered):
        raise TypeError(f"policy: expected a name, or a class or an instance made with @densify.policy, not {policy!r}")
    given = () if isinstance(policy, type) else policy._given
    return mark.name, {name: getattr(policy, name) for name in given}, mark.file


def not_in_a_file(name: str) -> InputError:
    """The error for a policy that only this process has."""
    return InputError(
        f"policy `{name}` is not in a file, so other processes cannot import it;"
        " write it to one (%%writefile in a notebook)"
    )


def file_of_name(name: str) -> str | None:
    """The file to import for a policy of this name in another process; None for built-in and installed ones."""
    known = _of_this_program.get(name)
    if known is not None and known.file is None:
        raise not_in_a_file(name)
    return None if known is None else known.file


def policies() -> list[PolicyInfo]:
    """All policies by name: built-in, installed, and registered by this program."""
    load_installed()
    return [PolicyInfo(*row[:5], parameters=dict(row[5])) for row in _densify.policies()]


def check_policy(policy: Any, **parameters: Any) -> None:
    """Runs the conformance suite on a policy, and compares its manual page with it.

    Raises DensifyError with a report of all checks that failed.
    """
    name, settings, _ = name_and_settings(policy)
    _densify.check_policy(name, json.dumps({**settings, **parameters}))
