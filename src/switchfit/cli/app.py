"""The command itself, the arguments that several commands take, and problem files."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import typer

from switchfit.cli.terminal import BAD_INPUT, fail, print_error, print_text, write_file

if TYPE_CHECKING:
    from switchfit.io.problem_file.building import ProblemFile
    from switchfit.runtime.issue import Issue

T = TypeVar("T")

DOTS = 150
"""Dots per inch of a figure."""

app = typer.Typer(
    name="switchfit",
    help="""When did it switch, and what were the parameters? Fits switched models to logs.

    Begin with `switchfit init NAME --from LOG`, or with one of `switchfit examples`.
    """,
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def option(*names: str, help: str, metavar: str | None = None) -> Any:
    """Return an option; its help says what holds without it."""
    return typer.Option(*names, metavar=metavar, help=help, show_default=False)


def argument(metavar: str, help: str, complete: Callable[[str], list[str]] | None = None) -> Any:
    """Return a positional argument."""
    return typer.Argument(metavar=metavar, help=help, show_default=False, autocompletion=complete)


def output_folder(content: str) -> Any:
    """Return the option --out for a folder with some content."""
    return option(metavar="DIR", help=f"Folder for {content}. Left out, nothing is written.")


ProblemPath = Annotated[Path, argument("PROBLEM.toml", "Problem file.")]
SavedPath = Annotated[Path, argument("ESTIMATE.json", "Written by switchfit fit --out.")]
Folder = Annotated[
    Path | None,
    option(metavar="DIR", help="Where data and models are. Default: where they were, seen from ESTIMATE.json."),
]
FigureFormat = Annotated[
    Literal["png", "pdf", "svg"], option("--figures", help="Format of the figure in --out. Default: png.")
]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON, and nothing else, to stdout.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors; the exit code tells the result.")]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Say on stderr what is being done, step by step.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show the full traceback of an error.")]


def _print_version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        print_text(f"switchfit {version('switchfit')}")
        raise typer.Exit


@app.callback()
def _collect_options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    pass


def load(problem: Path) -> ProblemFile:
    """Read a problem file."""
    from switchfit.io.problem_file import load_problem

    return load_problem(problem)


def read_pairs(given: str, name: str, form: str, read: Callable[[str], T]) -> list[tuple[str, T]]:
    """Return the pairs in ``A=0.5,B=1``; anything else in the option of a name ends the command."""
    pairs = [[side.strip() for side in part.rpartition("=")[::2]] for part in given.split(",")]
    with suppress(ValueError):
        if all(key and value for key, value in pairs):
            return [(key, read(value)) for key, value in pairs]
    fail(f"{name} must be {form}; got {given}.")


def print_list(title: str, entries: Sequence[object]) -> None:
    """Print a title and a line for each entry, such as what is odd about logs; nothing without entries."""
    if entries:
        print_text("\n".join([title, *(f"  {entry}" for entry in entries), ""]))


def write_figure(result: Any, path: Path) -> None:
    """Write the figure of a result; the ending of the name is its format."""
    figure, content = result.plot(), io.BytesIO()
    if path.suffix == ".png":
        _write_png(figure, content)
    else:
        figure.savefig(content, format=path.suffix[1:], dpi=DOTS)
    write_file(path, content.getvalue())


def _write_png(figure: Any, file: io.BytesIO) -> None:
    """Write what ``savefig`` does, in three quarters of its time.

    `savefig` draws a figure with a layout twice, the first time only to find the layout, which drawing once does too.
    """
    from matplotlib import rcParams
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.image import imsave

    if rcParams["savefig.bbox"] or rcParams["savefig.transparent"] or rcParams["savefig.facecolor"] != "auto":
        figure.savefig(file, format="png", dpi=DOTS)  # as matplotlibrc asks
        return
    figure.set_dpi(DOTS)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    imsave(file, canvas.buffer_rgba(), format="png", origin="upper", dpi=DOTS)


def fail_for_refused(issues: Sequence[Issue]) -> None:
    """Name the logs that could not be used, and end with the exit code that says so."""
    refused = [issue for issue in issues if issue.kind == "log: refused"]
    for issue in refused:
        print_error(issue)
    if refused:
        raise typer.Exit(BAD_INPUT)
