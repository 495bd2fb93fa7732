"""The terminal: what is printed, errors in a sentence with an exit code, Ctrl-C, and files that are written.

stdout has the result alone: a report, or with --json one JSON value. Notes and errors go to stderr.

The arguments that several commands take.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
import io
import logging
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn

import typer

from switchfit.io.user_files import describe_error, find_user_place
from switchfit.runtime.errors import InputError, Issue
from switchfit.runtime.files import write_atomically

if TYPE_CHECKING:
    from switchfit.io.problem_file.building import ProblemFile

CONVERGED, NOT_CONVERGED, BAD_INPUT, INTERNAL_ERROR, INTERRUPTED = 0, 1, 2, 3, 130

# --- output -----------------------------------------------------------------------------------------------------------


_asked: set[str] = set()
"""Of --json, --quiet, --verbose and --debug those that the command which runs was given."""


def is_asked(name: str) -> bool:
    """Return whether --json, --quiet, --verbose or --debug was given."""
    return name in _asked


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


def print_text(text: object) -> None:
    """Print a part of the result as text."""
    if not (is_asked("json") or is_asked("quiet")):
        _print(text)


def print_json(value: Any) -> None:
    """Print the result as JSON, if it is asked for."""
    if is_asked("json"):
        _print(format_json(value))


def format_json(value: Any) -> str:
    """Return a value as one line of JSON; numbers that are not finite are null."""
    from pydantic_core import to_json

    return to_json(value, inf_nan_mode="null", fallback=lambda array: array.tolist()).decode()


def print_note(text: object) -> None:
    """Print what the command does, to stderr."""
    if not is_asked("quiet"):
        _print(text, err=True)


def _print(text: object, *, err: bool = False) -> None:
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


def interrupt(number: int, frame: FrameType | None) -> NoReturn:
    """Raise `CtrlC`: a handler of SIGINT."""
    raise CtrlC


@contextlib.contextmanager
def report_errors() -> Iterator[None]:
    """Turn exceptions into a sentence on stderr and an exit code, including any exception of a model file."""
    try:
        with _log_if_verbose(), handle_interrupt(interrupt):
            yield
    except BaseException as error:
        users = find_user_place(error) is not None
        if isinstance(error, typer.Exit) and not users:
            raise
        if is_asked("debug"):
            traceback.print_exc()
        if isinstance(error, CtrlC) or (isinstance(error, KeyboardInterrupt) and not users):
            fail("interrupted before there was anything to write.", INTERRUPTED)
        if not (users or isinstance(error, Exception)):
            raise
        _explain(error, users=users)


def _explain(error: BaseException, *, users: bool) -> NoReturn:
    """Print the error and exit; `users` is whether it was raised in a file of the user."""
    if users and not isinstance(error, InputError):
        fail(f"{describe_error(error)}. (--debug shows the full traceback.)")
    if isinstance(error, OSError) and error.filename is not None:
        fail(f"{error.filename} cannot be read or written: {error.strerror}.")
    if isinstance(error, (ValueError, OSError)):
        fail(str(error))
    if isinstance(error, MemoryError):
        fail(f"not enough memory: {str(error) or 'the problem is too large'}.")
    if not is_asked("debug"):
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


def fail(message: str, code: int = BAD_INPUT) -> NoReturn:
    """Print a message to stderr and exit."""
    print_error(message)
    raise typer.Exit(code)


def end_unreliable(reason: str) -> NoReturn:
    """Print why the result is not to be relied on, except with --quiet, and exit with the code that says so."""
    if not is_asked("quiet"):
        print_error(reason)
    raise typer.Exit(NOT_CONVERGED)


def print_error(message: object) -> None:
    """Print what is wrong, to stderr."""
    _print(f"switchfit: {message}", err=True)


@contextlib.contextmanager
def stop_on_interrupt(describe: Callable[[Any], str], part: str = "iteration") -> Iterator[Callable[[Any], bool]]:
    """Return a context in which the first Ctrl-C requests a stop, and the second raises KeyboardInterrupt.

    It has the callback of a fit or a search, which says with --verbose how far that is, in the words of `describe`;
    with None it says nothing. `part` is what is brought to an end. During a search with strategies, which no callback
    can stop, the first one raises it: the search keeps its best fit.
    """
    from switchfit.strategy.choice import is_searching

    requested = threading.Event()

    def request(number: int, frame: FrameType | None) -> None:
        if requested.is_set() or is_searching():
            requested.set()
            raise CtrlC
        requested.set()
        print_note(f"stopping after this {part}; Ctrl-C again to stop at once")

    def report(progress: Any) -> bool:
        if is_asked("verbose") and progress is not None:
            print_note(f"  {describe(progress)}")
        return requested.is_set()

    with handle_interrupt(request):
        yield report


# --- files ------------------------------------------------------------------------------------------------------------


def load(problem: Path, out: Path | None = None, **how: Any) -> ProblemFile:
    """Load a problem file as `load_problem` does, and create the folder for the results."""
    from switchfit.io.problem_file import load_problem

    loaded = load_problem(problem, **how)
    make_folder(out)
    return loaded


def make_folder(folder: Path | None) -> None:
    """Create a folder, with those above it, unless it exists or none is asked for."""
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)


DOTS = 150
"""Dots per inch of a figure."""


def option(*names: str, help: str, metavar: str | None = None) -> Any:
    """Return an option; its help says what holds without it."""
    return typer.Option(*names, metavar=metavar, help=help, show_default=False)


def argument(metavar: str, help: str, **more: Any) -> Any:
    """Return a positional argument."""
    return typer.Argument(metavar=metavar, help=help, show_default=False, **more)


def output_folder(content: str) -> Any:
    """Return the option --out for a folder with some content."""
    return option(metavar="DIR", help=f"Folder for {content}. Left out, nothing is written.")


ProblemPath = Annotated[Path, argument("PROBLEM.toml", "Problem file.")]
SavedPath = Annotated[
    Path, argument("ESTIMATE.json", "Written by switchfit fit --out.", exists=True, dir_okay=False, readable=True)
]
Folder = Annotated[
    Path | None,
    option(metavar="DIR", help="Where data and models are. Default: where they were, seen from ESTIMATE.json."),
]
FigureFormat = Annotated[
    Literal["png", "pdf", "svg"], option("--figures", help="Format of the figure in --out. Default: png.")
]


def select_given(**options: Any) -> dict[str, Any]:
    """Return the options that are given; the others are None."""
    return {name: value for name, value in options.items() if value is not None}


def print_list(title: str, entries: Sequence[object]) -> None:
    """Print a title and a line for each entry, such as what is odd about logs; nothing without entries."""
    if entries:
        print_text("\n".join([title, *(f"  {entry}" for entry in entries), ""]))


def write_result(result: Any, stem: Path, figures: str, *, saved: bool = False) -> None:
    """Write the text of a result, its figure if `figures` names a format, and the result itself if it is to be saved.

    The files differ in their endings. Say where they are.
    """
    write_atomically(f"{result}\n", stem.with_suffix(".txt"))
    if saved:
        result.save(stem.with_suffix(".json"))
    if figures:
        write_figure(result, stem.with_suffix(f".{figures}"))
    print_note(f"written to {stem.parent}")


def show(
    result: Any, summary: dict[str, Any], out: Path | None, name: str, figures: str, *, saved: bool = False
) -> None:
    """Print a result, and write it as `write_result` does, if there is a folder for it."""
    print_text(result)
    if out is not None:
        write_result(result, out / name, figures, saved=saved)
    print_json(summary | {"out": out})


def write_figure(result: Any, path: Path) -> None:
    """Write the figure of a result; the ending of the name is its format."""
    os.environ.setdefault("MPLBACKEND", "Agg")
    content = io.BytesIO()
    result.plot().savefig(content, format=path.suffix[1:], dpi=DOTS)
    write_atomically(content.getvalue(), path)


def fail_for_refused(issues: Sequence[Issue]) -> None:
    """Name the logs that could not be used, and end with the exit code that says so."""
    refused = [issue for issue in issues if issue.kind == "log: refused"]
    for issue in refused:
        print_error(issue)
    if refused:
        raise typer.Exit(BAD_INPUT)


COMMON = {
    "json": Annotated[bool, typer.Option("--json", help="Print the result as JSON, and nothing else, to stdout.")],
    "quiet": Annotated[
        bool, typer.Option("--quiet", "-q", help="Print nothing but errors; the exit code tells the result.")
    ],
    "verbose": Annotated[bool, typer.Option("--verbose", "-v", help="Say on stderr what is being done, step by step.")],
    "debug": Annotated[bool, typer.Option("--debug", help="Show the full traceback of an error.")],
}
"""Options of which a command has some, and --debug in any case."""


def command(*options: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator that gives a command some of the common options, and runs it in `report_errors`."""
    names = (*options, "debug")

    def decorate(run: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(run)
        def run_command(**given: Any) -> None:
            _asked.update(name for name in names if given.pop(name))
            try:
                with report_errors():
                    run(**given)
            finally:
                _asked.clear()

        kind = inspect.Parameter.KEYWORD_ONLY
        added = [inspect.Parameter(name, kind, default=False, annotation=COMMON[name]) for name in names]
        own = inspect.signature(run, eval_str=True)
        run_command.__signature__ = own.replace(parameters=[*own.parameters.values(), *added])  # type: ignore[attr-defined]
        return run_command

    return decorate
