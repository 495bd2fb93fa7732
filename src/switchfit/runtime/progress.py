"""Progress of a long run, on the terminal or in a notebook.

A function that may take long opens a line (`show_line`, `show_progress`); what is done inside it says how far it is
(`show_detail`) without knowing whether anybody looks, or whether there is a line at all.
"""

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
from typing import TYPE_CHECKING, Any, TextIO

if TYPE_CHECKING:
    from rich.text import Text

DELAY = 1.0
"""Seconds after which the line of progress is shown; shorter calls show none."""

REDRAW = 0.2
"""Seconds between two drawings."""

Progress = Callable[[int, int], object]
"""``progress(done, total)``; a true return value stops the run."""

_current: ContextVar[Line | None] = ContextVar("line of progress", default=None)


def _is_terminal(stream: TextIO | None) -> bool:
    """Return whether a stream is a terminal; False if it is closed, or None as in a program without a console."""
    try:
        return stream is not None and bool(stream.isatty())
    except ValueError:  # it is closed
        return False


def _is_notebook() -> bool:
    """Return whether the code runs in a notebook: in IPython with a kernel."""
    ipython = sys.modules.get("IPython")  # a notebook has imported it
    return ipython is not None and hasattr(ipython.get_ipython(), "kernel")


class Line:
    """One line about what a long call is doing, with the seconds since it began, and how much is done where that is
    known; removed at the end of the call.

    A thread of its own draws it, so that it is updated while machine code runs or a program is compiled. In a notebook
    it stands below the cell, with a bar. Unless it `is_shown`, nothing draws it.
    """

    def __init__(self, text: str) -> None:
        self.text, self.detail, self.lowest = text, "", math.inf
        self.done = self.total = 0
        self.is_shown, self.began, self.ended = False, time.monotonic(), threading.Event()

    def write(self, text: str, lowest: float = math.inf) -> None:
        """Replace the text, and the lowest J so far; infinity shows none."""
        self.text, self.detail, self.lowest = text, "", lowest

    def draw(self) -> None:
        """Draw the line, after `DELAY` seconds, until the call ends."""
        # Most calls end before it is shown: they have cost a thread, and nothing was imported for drawing.
        if self.ended.wait(DELAY):
            return
        with _show_below(self) if _is_notebook() else _show_on_terminal(self) as redraw:
            while not self.ended.wait(REDRAW):
                redraw()

    def describe(self) -> str:
        """Return what is shown."""
        seconds = time.monotonic() - self.began
        parts = [self.text, f"lowest J = {self.lowest:.6g}" if math.isfinite(self.lowest) else "", self.detail]
        if self.total:
            parts.append(
                f"{self.done}/{self.total}, {seconds * (self.total - self.done) / max(self.done, 1):.0f} s left"
            )
        return f"{', '.join(filter(None, parts))}   {seconds:.0f} s"

    def __rich__(self) -> Text:
        from rich.text import Text

        return Text(self.describe(), no_wrap=True, overflow="ellipsis")


@contextmanager
def _show_on_terminal(line: Line) -> Iterator[Callable[[], object]]:
    from rich.console import Console
    from rich.live import Live

    # What else is printed during the call goes above the line; where stdout is a file or a pipe it is left alone.
    console, redirect = Console(stderr=True), _is_terminal(sys.stdout)
    settings: dict[str, Any] = {"redirect_stdout": redirect, "redirect_stderr": redirect, "auto_refresh": False}
    with Live(line, console=console, transient=True, **settings) as live:
        yield live.refresh


@contextmanager
def _show_below(line: Line) -> Iterator[Callable[[], object]]:
    """Show a line below the cell of a notebook."""
    shown = importlib.import_module("IPython.display")  # is there in a notebook alone

    def describe() -> object:
        bar = f' value="{line.done}" max="{line.total}"' if line.total else ""
        return shown.HTML(f"<progress{bar}></progress> {escape(line.describe())}")

    output = shown.display(describe(), display_id=True)
    yield lambda: output.update(describe())
    output.update(shown.HTML(""))


@contextmanager
def show_line(text: str) -> Iterator[Line]:
    """Return a context that yields the line of a long call, shown on a terminal or in a notebook.

    A call inside another one, or outside the main thread, gets a line that is not shown.
    """
    line = Line(text)
    # A line of a call inside another one would be drawn over the outer one; beside the main thread nobody looks.
    is_first = _current.get() is None and threading.current_thread() is threading.main_thread()
    line.is_shown = is_first and (_is_terminal(sys.stderr) or _is_notebook())
    token = _current.set(line)
    # ipykernel finds the cell of an output by a context variable.
    thread = threading.Thread(target=copy_context().run, args=(line.draw,), daemon=True)
    if line.is_shown:
        thread.start()
    try:
        yield line
    finally:
        _current.reset(token)
        # Joined before the call returns: nothing is drawn over what the caller prints next.
        line.ended.set()
        if line.is_shown:
            thread.join()


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
