"""Progress of runs: a line in terminals and notebooks, and the callbacks of the caller."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from typing import Any


class Listener:
    """Receives the progress of a run from Rust, on the thread that trains."""

    def __init__(
        self,
        progress: bool,
        on_step: Callable[[int, float, int], object] | None = None,
        on_record: Callable[[dict[str, Any]], object] | None = None,
        on_edit: Callable[[dict[str, Any]], object] | None = None,
        on_test: Callable[[int, dict[str, float]], object] | None = None,
    ) -> None:
        self._progress = progress
        self._on_step = on_step
        self._on_record = on_record
        self._on_edit = on_edit
        self._on_test = on_test
        self._last = self._done = 0
        self._text = ""
        self._shown = False
        self._start = 0.0
        self._line: Any = None
        # Otherwise steps are reported ten times a second.
        self.every_step = on_step is not None
        self._drawn = 0.0

    def say(self, line: str) -> None:
        if self._progress:
            self._clear()
            print(line)

    def begin(self, done: int, last: int, budget: int) -> None:
        self._done, self._last, self._start = done, last, time.monotonic()

    def step(self, step: int, loss: float, rows: int) -> None:
        if self._on_step is not None:
            self._on_step(step, loss, rows)
        if not self._progress:
            return
        now = time.monotonic()
        speed = (step - self._done) / max(now - self._start, 1e-9)
        self._text = f"step {step}/{self._last}  {speed:.1f} it/s  loss {loss:.4f}  {rows:,} Gaussians"
        if now - self._drawn >= 0.1:
            self._drawn = now
            self._draw()

    def recorded(self, record: str) -> None:
        if self._on_record is not None:
            self._on_record(json.loads(record))

    def edited(self, event: str) -> None:
        if self._on_edit is not None:
            self._on_edit(json.loads(event))

    def tested(self, scores: str) -> None:
        if self._on_test is not None:
            step, mean = json.loads(scores)
            self._on_test(step, mean)

    def end(self) -> None:
        # The last step may have been too soon after another one.
        if self._text:
            self._draw()
        self._clear()

    def _draw(self) -> None:
        text = self._text
        handle = _notebook_line(self._line, text)
        if handle is not None:
            self._line = handle
        elif sys.stderr is not None and sys.stderr.isatty():
            print(f"\r\x1b[K{text}", end="", file=sys.stderr, flush=True)
            self._shown = True

    def _clear(self) -> None:
        if self._shown:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)
            self._shown = False


def _notebook_line(handle: Any, text: str) -> Any:
    """Shows a line in a notebook, in place of the last one; None outside of notebooks."""
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython is not None else None
    if shell is None or type(shell).__name__ != "ZMQInteractiveShell":
        return None
    from IPython.display import display  # type: ignore[import-not-found, unused-ignore]

    content = {"text/plain": text}
    if handle is None:
        return display(content, raw=True, display_id=True)
    handle.update(content, raw=True)
    return handle
