"""Ctrl-C: the first one ends a fit after its iteration, the second one at once."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import NoReturn, TypeVar

from switchfit.cli.terminal import is_asked, print_note

Progress = TypeVar("Progress")
"""What a fit or a search tells its callback."""


class CtrlC(KeyboardInterrupt):
    """Ctrl-C at the keyboard, and not a KeyboardInterrupt that a model file raises."""


def interrupt(number: int, frame: FrameType | None) -> NoReturn:
    """Raise `CtrlC`: a handler of SIGINT."""
    raise CtrlC


@contextlib.contextmanager
def handle_interrupt(handler: Callable[[int, FrameType | None], object]) -> Iterator[None]:
    """Return a context in which Ctrl-C calls a handler; without effect if SIGINT is ignored, or outside the main
    thread, which alone has signal handlers.
    """
    # SIGINT that is ignored, as under nohup or in a background job of a shell, stays ignored.
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or before in (signal.SIG_IGN, None):
        yield
        return
    signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextlib.contextmanager
def stop_on_interrupt(
    describe: Callable[[Progress], str], part: str = "iteration"
) -> Iterator[Callable[[Progress | None], bool]]:
    """Return a context in which the first Ctrl-C requests a stop, and the second raises KeyboardInterrupt.

    It has the callback of a fit or a search, which says with --verbose how far that is, in the words of `describe`;
    with None it says nothing. `part` is what is brought to an end. During a search with strategies, which no callback
    can stop, the first one raises it: the search keeps its best fit.
    """
    from switchfit.strategy.search import is_searching

    requested = threading.Event()

    def request(number: int, frame: FrameType | None) -> None:
        # A search with strategies cannot be asked to stop by the callback of one of its fits, which others follow. It
        # catches the exception, and keeps its best fit.
        if requested.is_set() or is_searching():
            requested.set()
            raise CtrlC
        requested.set()
        print_note(f"stopping after this {part}; Ctrl-C again to stop at once")

    def report(progress: Progress | None) -> bool:
        if is_asked("verbose") and progress is not None:
            print_note(f"  {describe(progress)}")
        return requested.is_set()

    with handle_interrupt(request):
        yield report
