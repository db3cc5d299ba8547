"""Exceptions. Their messages are those of the command line, with options spelled as keyword arguments."""

from __future__ import annotations


class DensifyError(Exception):
    """A failure: of the policy, the disk, or training."""

    #: Exit code of the command for the same failure.
    code = 1


class InputError(DensifyError, ValueError):
    """Bad input: an option, a file, a field."""

    code = 2


class DeviceError(DensifyError):
    """The device or the memory does not suffice."""

    code = 3


class PolicyError(DensifyError):
    """A policy has raised an exception, which is the ``__cause__``."""


class Undeclared(DensifyError, RuntimeError):
    """A plan holds an edit that the policy's needs do not declare."""


class Interrupted(KeyboardInterrupt):
    """A run was stopped between two steps; the message names its checkpoint."""

    code = 130
