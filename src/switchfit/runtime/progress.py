"""Progress of a long run, on the terminal or in a notebook."""

from __future__ import annotations

import importlib
import math
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar, copy_context
from html import escape
from typing import Any

DELAY = 1.0
"""Seconds after which the line of progress is shown; shorter calls show none."""

REDRAW = 0.2
"""Seconds between two drawings in a notebook."""

Progress = Callable[[int, int], object]
"""``progress(done, total)``; a true return value stops the run."""


def is_terminal(stream: Any) -> bool:
    """Return whether a stream is a terminal; False if it is closed, or None as in a program without a console."""
    try:
        return stream is not None and bool(stream.isatty())
    except ValueError:  # it is closed
        return False


def is_notebook() -> bool:
    """Return whether the code runs in a notebook: in IPython with a kernel."""
    ipython = sys.modules.get("IPython")  # a notebook has imported it
    return ipython is not None and hasattr(ipython.get_ipython(), "kernel")


class Line:
    """One line about what a long call is doing, with the seconds since it began, and how much is done where that is
    known; removed at the end of the call.

    Threads of its own draw it, so that it is updated while machine code runs or a program is compiled. In a notebook it
    stands below the cell, with a bar.
    """

    def __init__(self, text: str) -> None:
        self.text, self.detail, self.lowest = text, "", math.inf
        self.done = self.total = 0
        self._began = time.monotonic()
        self._live: Any = None
        self._timer: threading.Timer | None = None

    def write(self, text: str, lowest: float = math.inf) -> None:
        """Replace the text, and the lowest J so far; infinity shows none."""
        self.text, self.detail, self.lowest = text, "", lowest

    @property
    def is_started(self) -> bool:
        """Whether the line is shown if the call takes longer than `DELAY`."""
        return self._timer is not None

    def start(self) -> None:
        """Show the line after `DELAY` seconds."""
        self._ended = threading.Event()
        show = self._show_below if is_notebook() else self._show
        # ipykernel finds the cell of an output by a context variable.
        self._timer = threading.Timer(DELAY, copy_context().run, args=(show,))
        self._timer.daemon = True
        self._timer.start()

    def end(self) -> None:
        """Remove the line."""
        if self._timer is None:
            return
        self._timer.cancel()
        self._ended.set()
        self._timer.join()
        if self._live is not None:
            self._live.stop()

    def _show(self) -> None:
        from rich.console import Console
        from rich.live import Live

        console, redirect = Console(stderr=True), is_terminal(sys.stdout)
        settings: dict[str, Any] = {"redirect_stdout": redirect, "redirect_stderr": redirect}
        self._live = Live(self, console=console, transient=True, refresh_per_second=5, **settings)
        self._live.start()

    def _show_below(self) -> None:
        """Draw the line below the cell until the call ends."""
        shown = importlib.import_module("IPython.display")  # is there in a notebook alone
        output = None
        while not self._ended.wait(REDRAW):
            bar = f' value="{self.done}" max="{self.total}"' if self.total else ""
            html = shown.HTML(f"<progress{bar}></progress> {escape(self._describe())}")
            if output is None:
                output = shown.display(html, display_id=True)
            else:
                output.update(html)
        if output is not None:
            output.update(shown.HTML(""))

    def _describe(self) -> str:
        """Return what is shown."""
        seconds = time.monotonic() - self._began
        parts = [self.text, f"lowest J = {self.lowest:.6g}" if math.isfinite(self.lowest) else "", self.detail]
        if self.total:
            parts.append(
                f"{self.done}/{self.total}, {seconds * (self.total - self.done) / max(self.done, 1):.0f} s left"
            )
        return f"{', '.join(filter(None, parts))}   {seconds:.0f} s"

    def __rich__(self) -> Any:
        from rich.text import Text

        return Text(self._describe(), no_wrap=True, overflow="ellipsis")


_current: ContextVar[Line | None] = ContextVar("line of progress", default=None)


@contextmanager
def show_line(text: str) -> Iterator[Line]:
    """Return a context that yields the line of a long call, shown on a terminal or in a notebook.

    A call inside another one, or outside the main thread, gets a line that is not shown.
    """
    line = Line(text)
    is_first = _current.get() is None and threading.current_thread() is threading.main_thread()
    token = _current.set(line)
    if is_first and (is_terminal(sys.stderr) or is_notebook()):
        line.start()
    try:
        yield line
    finally:
        _current.reset(token)
        line.end()


@contextmanager
def show_progress(callback: Progress | None, title: str) -> Iterator[Progress]:
    """Return a context that yields the callback of a long run, which calls the user's and draws a bar as `show_line`.

    Parameters
    ----------
    callback : callable, optional
    title : str
        Title of the bar.
    """
    with show_line(title) as line:

        def report(done: int, total: int) -> object:
            line.done, line.total = done, total
            return callback is not None and callback(done, total)

        yield report


def show_detail(detail: str, cost: float = math.inf) -> None:
    """Add to the line of the running call how far it is, and a cost that may be the lowest.

    Parameters
    ----------
    detail : str
        Such as "window 3 of 9".
    cost : float
    """
    line = _current.get()
    if line is not None:
        line.detail, line.lowest = detail, min(line.lowest, cost)
