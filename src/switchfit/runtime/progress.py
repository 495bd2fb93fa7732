"""Progress of a long run on the terminal."""

from __future__ import annotations

import sys
from collections.abc import Callable

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
    bar = rich.progress.Progress(*columns, console=Console(stderr=True), transient=True)
    task = bar.add_task(title, total=None)
    bar.start()

    def report(done: int, total: int) -> object:
        bar.update(task, completed=done, total=total)
        return callback is not None and callback(done, total)

    return report, bar.stop
