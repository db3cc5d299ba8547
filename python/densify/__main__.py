"""The ``densify`` command: the program that ``cargo install`` builds, and policies written in Python."""

from __future__ import annotations

import signal
import sys

from densify import _densify, _policy


def main() -> int:
    """Runs the command line of this process."""
    # The command handles signals itself; Python's handler would only note them.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    _policy.load_installed()
    return _densify.main(["densify", *sys.argv[1:]])


if __name__ == "__main__":
    sys.exit(main())
