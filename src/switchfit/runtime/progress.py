"""Progress of a long run on the terminal."""

from __future__ import annotations

import sys
from collections.abc import Callable

Progress = Callable[[int, int], object]
"""``progress(done, total)``; a true value stops."""


def show_progress(callback: Progress | None, title: str) -> tuple[Progress, Callable[[], None]]:
    """Return a context that yields the callback of a long run: the user's, with a bar on a terminal.

    Parameters
    ----------
    callback : callable, optional
    title : str
        Of the bar.

    Returns
    -------
    report : callable ``(done, total)``
    end : callable without arguments
        Takes the bar away.
    """
    if not sys.stderr.isatty():
        return (lambda done, total: callback is not None and callback(done, total)), lambda: None
    import rich.progress
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    bar = rich.progress.Progress(*columns, console=Console(stderr=True), transient=True)
    task = bar.add_task(title, total=None)
    bar.start()

    def report(done: int, total: int) -> object:
        bar.update(task, completed=done, total=total)
        return callback is not None and callback(done, total)

    return report, bar.stop
