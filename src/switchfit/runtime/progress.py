"""Progress of a long run on the terminal."""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

DELAY = 1.0
"""Seconds after which a line is shown: what ends sooner needs none."""

Progress = Callable[[int, int], object]
"""``progress(done, total)``; a true return value stops the run."""


def show_progress(callback: Progress | None, title: str) -> tuple[Progress, Callable[[], None]]:
    """Return the callback of a long run, which calls the user's and draws a bar on a terminal.

    Parameters
    ----------
    callback : callable, optional
    title : str
        Title of the bar.

    Returns
    -------
    report : callable ``(done, total)``
    end : callable without arguments
        Removes the bar.
    """
    if not sys.stderr.isatty():
        return (lambda done, total: callback is not None and callback(done, total)), lambda: None
    import rich.progress
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    # What a callback prints to a file must get there: only a terminal's output is led around the bar.
    redirect = sys.stdout.isatty()
    bar = rich.progress.Progress(
        *columns, console=Console(stderr=True), transient=True, redirect_stdout=redirect, redirect_stderr=redirect
    )
    task = bar.add_task(title, total=None)
    bar.start()

    def report(done: int, total: int) -> object:
        bar.update(task, completed=done, total=total)
        return callback is not None and callback(done, total)

    return report, bar.stop


class Line:
    """One line about what a long call does, with the seconds since it began; taken away at its end.

    It is drawn by threads of its own, so that it moves while machine code runs or something is compiled.
    """

    def __init__(self, text: str) -> None:
        self.text, self.detail, self.lowest = text, "", math.inf
        self._began = time.monotonic()
        self._live: Any = None
        self._ended = False
        self._lock = threading.Lock()
        self._timer: threading.Timer | None = None

    def write(self, text: str, lowest: float = math.inf) -> None:
        """Say something else, and the lowest J so far if there is one."""
        self.text, self.detail, self.lowest = text, "", lowest

    @property
    def is_started(self) -> bool:
        """Whether it will be shown if the call lasts."""
        return self._timer is not None

    def start(self) -> None:
        """Show the line from `DELAY` seconds on."""
        self._timer = threading.Timer(DELAY, self._show)
        self._timer.daemon = True
        self._timer.start()

    def end(self) -> None:
        """Take the line away."""
        if self._timer is None:
            return
        self._timer.cancel()
        with self._lock:
            self._ended = True
            if self._live is not None:
                self._live.stop()

    def _show(self) -> None:
        from rich.console import Console
        from rich.live import Live

        console, redirect = Console(stderr=True), sys.stdout.isatty()
        settings: dict[str, Any] = {"redirect_stdout": redirect, "redirect_stderr": redirect}
        with self._lock:
            if not self._ended:
                self._live = Live(self, console=console, transient=True, refresh_per_second=5, **settings)
                self._live.start()

    def __rich__(self) -> Any:
        from rich.text import Text

        lowest = f"lowest J = {self.lowest:.6g}" if math.isfinite(self.lowest) else ""
        whole = ", ".join(part for part in (self.text, lowest, self.detail) if part)
        return Text(f"{whole}   {time.monotonic() - self._began:.0f} s", no_wrap=True, overflow="ellipsis")


_current: ContextVar[Line | None] = ContextVar("line of progress", default=None)


@contextmanager
def show_line(text: str) -> Iterator[Line]:
    """Return a context that yields the line of a long call, on a terminal; calls inside another one show nothing."""
    line = Line(text)
    is_first = _current.get() is None and threading.current_thread() is threading.main_thread()
    token = _current.set(line)
    if is_first and sys.stderr.isatty():
        line.start()
    try:
        yield line
    finally:
        _current.reset(token)
        line.end()


def show_detail(detail: str, cost: float = math.inf) -> None:
    """Add to the line of the call under way how far it is, such as "window 3 of 9", and a J that may be the lowest.

    Parameters
    ----------
    detail : str
    cost : float
    """
    line = _current.get()
    if line is not None:
        line.detail, line.lowest = detail, min(line.lowest, cost)
