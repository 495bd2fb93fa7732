"""How a command ends: exit codes, and errors as a sentence on stderr."""

from __future__ import annotations

import contextlib
import logging
import traceback
from collections.abc import Iterator, Sequence
from typing import NoReturn

import typer

from switchfit.cli.interrupts import CtrlC, handle_interrupt, interrupt
from switchfit.cli.terminal import is_asked, print_error
from switchfit.io.user_files import describe_error, find_user_place
from switchfit.runtime.errors import InputError
from switchfit.runtime.issue import Issue

EXIT_CONVERGED, EXIT_NOT_CONVERGED, EXIT_BAD_INPUT, EXIT_INTERNAL_ERROR, EXIT_INTERRUPTED = 0, 1, 2, 3, 130


@contextlib.contextmanager
def _log_if_verbose() -> Iterator[None]:
    """Return a context in which --verbose shows the log messages of switchfit, and not together with --quiet."""
    if not is_asked("verbose"):
        yield
        return
    if is_asked("quiet"):
        fail("--quiet and --verbose contradict each other; give one of them.")
    logger, handler = logging.getLogger("switchfit"), logging.StreamHandler()
    level = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)


@contextlib.contextmanager
def report_errors() -> Iterator[None]:
    """Turn exceptions into a sentence on stderr and an exit code, including any exception of a model file."""
    try:
        with _log_if_verbose(), handle_interrupt(interrupt):
            yield
    # All of it: a model file may call sys.exit, or raise KeyboardInterrupt, and that must not look like an exit code or
    # a Ctrl-C of ours. Whether it comes from a user's file is asked first.
    except BaseException as error:
        users = find_user_place(error) is not None
        if isinstance(error, typer.Exit) and not users:
            raise
        if is_asked("debug"):
            traceback.print_exc()
        # A result so far is handled inside, by `stop_on_interrupt`; what arrives here came before there was any.
        if isinstance(error, CtrlC) or (isinstance(error, KeyboardInterrupt) and not users):
            fail("interrupted before there was anything to write.", EXIT_INTERRUPTED)
        if not (users or isinstance(error, Exception)):
            raise
        _explain(error, users=users)


def _explain(error: BaseException, *, users: bool) -> NoReturn:
    """Print the error and exit; `users` is whether it was raised in a file of the user."""
    if users and not isinstance(error, InputError):
        fail(f"{describe_error(error)}. (--debug shows the full traceback.)")
    # Its own text begins with the number of the error.
    if isinstance(error, OSError) and error.filename is not None:
        fail(f"{error.filename} cannot be read or written: {error.strerror}.")
    if isinstance(error, (ValueError, OSError)):
        fail(str(error))
    if isinstance(error, MemoryError):
        fail(f"not enough memory: {str(error) or 'the problem is too large'}.")
    # The traceback was printed above, if --debug asked for it.
    if not is_asked("debug"):
        traceback.print_exception(error)
    fail("this is an error in switchfit itself; please report it with the lines above.", EXIT_INTERNAL_ERROR)


def fail(message: str, code: int = EXIT_BAD_INPUT) -> NoReturn:
    """Print a message to stderr and exit."""
    print_error(message)
    raise typer.Exit(code)


def end_unreliable(reason: str) -> NoReturn:
    """Print why the result is not to be relied on, except with --quiet, and exit with the code that says so."""
    if not is_asked("quiet"):
        print_error(reason)
    raise typer.Exit(EXIT_NOT_CONVERGED)


def fail_for_refused(issues: Sequence[Issue]) -> None:
    """Name the logs that could not be used, and end with the exit code that says so."""
    refused = [issue for issue in issues if issue.kind == "log: refused"]
    for issue in refused:
        print_error(issue)
    if refused:
        raise typer.Exit(EXIT_BAD_INPUT)
