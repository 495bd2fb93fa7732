"""The terminal: what is printed, errors in a sentence with an exit code, Ctrl-C, and files that are written."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import NoReturn

import typer

CONVERGED, NOT_CONVERGED, BAD_INPUT, INTERNAL_ERROR, INTERRUPTED = 0, 1, 2, 3, 130

# --- output -----------------------------------------------------------------------------------------------------------


def print_text(text: object, *, err: bool = False) -> None:
    """Print to stdout or stderr; if its reader has closed it, as ``head`` does, print nothing from then on.

    The command continues: its files and its exit code do not depend on a reader.
    """
    try:
        typer.echo(text, err=err)
    except BrokenPipeError:
        stream = sys.stderr if err else sys.stdout
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())  # buffered text is flushed there, at the latest when Python exits
        os.close(nowhere)


# --- errors -----------------------------------------------------------------------------------------------------------


class CtrlC(KeyboardInterrupt):
    """Ctrl-C at the keyboard, and not a KeyboardInterrupt that a model file raises."""


def _interrupt(number: int, frame: FrameType | None) -> NoReturn:
    raise CtrlC


@contextlib.contextmanager
def report_errors(debug: bool) -> Iterator[None]:
    """Turn exceptions into a sentence on stderr and an exit code, including any exception of a model file."""
    try:
        with handle_interrupt(_interrupt):
            yield
    except BaseException as error:
        from switchfit.io.python_file import find_user_place

        users = find_user_place(error) is not None
        if isinstance(error, typer.Exit) and not users:
            raise
        if debug:
            traceback.print_exc()
        if isinstance(error, CtrlC) or (isinstance(error, KeyboardInterrupt) and not users):
            fail("interrupted before there was anything to write.", INTERRUPTED)
        if not (users or isinstance(error, Exception)):
            raise
        _explain(error, users=users, debug=debug)


def _explain(error: BaseException, *, users: bool, debug: bool) -> NoReturn:
    """Print the error and exit; `users` is whether it was raised in a file of the user."""
    from switchfit.io.python_file import describe_error
    from switchfit.runtime.errors import InputError

    if users and not isinstance(error, InputError):
        fail(f"{describe_error(error)}. (--debug shows the full traceback.)", BAD_INPUT)
    if isinstance(error, (ValueError, OSError)):
        fail(str(error), BAD_INPUT)
    if isinstance(error, MemoryError):
        fail(f"not enough memory: {str(error) or 'the problem is too large'}.", BAD_INPUT)
    if not debug:
        traceback.print_exception(error)
    fail("this is an error in switchfit itself; please report it with the lines above.", INTERNAL_ERROR)


@contextlib.contextmanager
def handle_interrupt(handler: Callable[[int, FrameType | None], object]) -> Iterator[None]:
    """Return a context in which Ctrl-C calls a handler; without effect if SIGINT is ignored, or outside the main
    thread, which alone has signal handlers.
    """
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or before in (signal.SIG_IGN, None):
        yield
        return
    signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def fail(message: str, code: int) -> NoReturn:
    """Print a message to stderr and exit."""
    print_text(f"switchfit: {message}", err=True)
    raise typer.Exit(code)


@contextlib.contextmanager
def stop_on_interrupt() -> Iterator[Callable[[], bool]]:
    """Return a context in which the first Ctrl-C requests a stop, and the second raises KeyboardInterrupt.

    During a search with strategies, which no callback can stop, the first one raises it: the search keeps its best fit.
    """
    from switchfit.strategy.choice import is_searching

    requested = threading.Event()

    def request(number: int, frame: FrameType | None) -> None:
        if requested.is_set() or is_searching():
            requested.set()
            raise CtrlC
        requested.set()
        print_text("stopping after this iteration; Ctrl-C again to stop at once", err=True)

    with handle_interrupt(request):
        yield requested.is_set


# --- files ------------------------------------------------------------------------------------------------------------


def make_folder(folder: Path) -> None:
    """Create a folder, with those above it, unless it exists."""
    from switchfit.runtime.errors import InputError

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"the folder {folder} cannot be created: {error.strerror}; name another with --out."
        ) from error


@contextlib.contextmanager
def explain_write_errors(path: Path) -> Iterator[Path]:
    """Return a context that turns an OSError into an InputError with the name of the file and the reason."""
    from switchfit.runtime.errors import InputError

    try:
        yield path
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror}; name another with --out.") from error


def write_file(path: Path, content: str | bytes) -> None:
    """Write a file atomically."""
    from switchfit.runtime.files import write_atomically

    with explain_write_errors(path):
        write_atomically(content, path)
