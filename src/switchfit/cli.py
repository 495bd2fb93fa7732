"""The command line: ``switchfit fit | check | simulate | paper``.

Exit codes: 0 converged and the verdict is good or doubtful, 1 not converged or bad (the result is still written),
2 wrong input, 3 an error of switchfit itself, 130 interrupted by Ctrl-C. Only typer is imported here; the numerical
parts are imported when a command needs them, so that ``--help`` is fast.
"""

from __future__ import annotations

import contextlib
import csv
import io
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn

import typer

if TYPE_CHECKING:
    from switchfit.io.problem_file import ProblemFile
    from switchfit.runtime.issue import Issue

CONVERGED, NOT_CONVERGED, BAD_INPUT, INTERNAL_ERROR, INTERRUPTED = 0, 1, 2, 3, 130

app = typer.Typer(
    name="switchfit",
    help="When did it switch, and what were the parameters? Fits switched models to measurements.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

ProblemPath = Annotated[Path, typer.Argument(metavar="PROBLEM.toml", help="Problem file.", show_default=False)]
Debug = Annotated[bool, typer.Option("--debug", help="Show the full traceback of an error.")]


def main() -> None:
    """Entry point of the ``switchfit`` command."""
    app()


def _print_version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        _print(f"switchfit {version('switchfit')}")
        raise typer.Exit


@app.callback()
def _collect_options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    pass


@app.command()
def fit(
    problem: Annotated[
        list[Path],
        typer.Argument(
            metavar="PROBLEM.toml",
            help="Problem file; with --problem, logs, each of which is fitted by itself.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for report.html, report.txt, estimate.json, fit.png; runs.csv, unknowns.csv for many.",
            show_default=False,
        ),
    ] = None,
    model: Annotated[
        Path | None,
        typer.Option(
            "--problem", metavar="PROBLEM.toml", help="Problem file for the logs that are named.", show_default=False
        ),
    ] = None,
    table: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.csv", help="With --problem: a line for each log; FILE.parquet too.", show_default=False
        ),
    ] = None,
    strategy: Annotated[
        Literal["local", "auto", "thorough"] | None,
        typer.Option(help="One fit, more if its verdict is not good, or all strategies.", show_default="auto"),
    ] = None,
    time_budget: Annotated[
        float | None, typer.Option(min=0.0, help="Seconds after which no further strategy begins.", show_default="none")
    ] = None,
    hessian: Annotated[
        Literal["auto", "exact", "descent-first", "block-diagonal", "gauss-newton", "none"] | None,
        typer.Option(help="Quadratic term of the optimizer.", show_default="auto"),
    ] = None,
    tolerance: Annotated[
        float | None, typer.Option(min=0.0, help="Optimality at which to stop.", show_default="the library's")
    ] = None,
    max_iterations: Annotated[
        int | None, typer.Option(min=0, help="Most iterations.", show_default="the library's")
    ] = None,
    figures: Annotated[Literal["png", "pdf", "svg"], typer.Option(help="Format of the figure in --out.")] = "png",
    no_figures: Annotated[
        bool, typer.Option("--no-figures", help="Write no figures: neither fit.png (.pdf, .svg) nor report.html.")
    ] = False,
    certificate: Annotated[
        bool, typer.Option("--certificate", help="Check with the paper's equations too, and print the checks.")
    ] = False,
    full: Annotated[
        bool, typer.Option("--full", help="Report all runs, channels, unknowns and warnings, not one screen.")
    ] = False,
    debug: Debug = False,
) -> None:
    """Estimate transition times and parameters; report on the terminal, report and figure in --out.

    Options given here override those in the problem file. Ctrl-C stops after the current iteration and reports the
    result so far. Exit code 0: converged, the verdict is good or doubtful; 1: not converged or bad, the result is still
    written; 2: the input is wrong.

    LOG ... --problem PROBLEM.toml fits each of the logs by itself, in place of the file that the data name. A pattern
    or a folder stands for the logs in it. A log that cannot be used is reported, and the next one is fitted; the exit
    code is that of the worst.
    """
    given = {
        "strategy": strategy,
        "time_budget": time_budget,
        "hessian": hessian,
        "tolerance": tolerance,
        "max_iterations": max_iterations,
    }
    overrides = {key: value for key, value in given.items() if value is not None}
    drawn = "" if out is None or no_figures else figures
    output = _Output(out, figures=drawn, certificate=certificate, full=full)
    if model is not None:
        with _report_errors(debug):
            code = _fit_logs(problem, model, overrides, output, table)
        if code != CONVERGED:
            raise typer.Exit(code)
        return
    if len(problem) != 1 or table is not None:
        _fail("name one problem file; to fit several logs by one, name it with --problem PROBLEM.toml.", BAD_INPUT)
    with _report_errors(debug):
        loaded = _load(problem[0])
        if out is not None:
            _make_folder(out)
        options = loaded.options | overrides
        estimate = _estimate(loaded, options, prepare_figures=bool(output.figures))
        _write_estimate(estimate, loaded, options, output, output.folder)
    _fail_for_refused(loaded.issues)
    if not estimate.success:
        reason = "" if estimate.status.successful else f"not converged. {estimate.message}"
        _print(f"switchfit: {reason or 'the fit is bad; the first line of the report says why.'}", err=True)
        raise typer.Exit(NOT_CONVERGED)


@app.command()
def check(
    problem: ProblemPath,
    no_run: Annotated[
        bool, typer.Option("--no-run", help="Read the problem file and its data; run no Python file that it names.")
    ] = False,
    debug: Debug = False,
) -> None:
    """Check a problem without fitting it: data, derivatives, identifiability at the first guess.

    Exit code 0: the derivatives are right; 1: they are not; 2: the input is wrong.
    """
    if no_run:
        with _report_errors(debug):
            _check_files(problem)
        return
    with _report_errors(debug):
        loaded = _load(problem)
        import switchfit as sf
        from switchfit.io.summary import describe, describe_steps

        _print(f"{describe(loaded.problem)}\n")
        _print_issues(loaded.issues)
        _print(f"{describe_steps(loaded.problem)}\n")
        derivatives = sf.check_derivatives(loaded.problem)
        _print(f"{derivatives}\n")
        _print(sf.identifiability(loaded.problem))
    _fail_for_refused(loaded.issues)
    if not derivatives.passed:
        raise typer.Exit(NOT_CONVERGED)


@app.command()
def simulate(
    problem: ProblemPath,
    out: Annotated[Path, typer.Option(metavar="FILE.csv", help="CSV file to write.", show_default=False)],
    times: Annotated[
        str,
        typer.Option(
            metavar="STEP",
            help="A step, such as 0.1: a grid from t0 to tf; or 'samples': the times of the data.",
            show_default="the integrator's steps",
        ),
    ] = "",
    debug: Debug = False,
) -> None:
    """Integrate the model at the first guess and write time, mode and states as CSV.

    The column of times is named t, or for example "t (min)" if the experiments' time_unit is "min" instead of "s".
    """
    with _report_errors(debug):
        loaded = _load(problem)
        import switchfit as sf
        from switchfit.io.grid import choose_times

        given = [choose_times(times, experiment) for experiment in loaded.problem.experiments]
        runs = [sf.simulate(loaded.problem, experiment=e, times=when) for e, when in enumerate(given)]
        units = {run.time_unit for run in runs}
        if len(units) > 1:
            raise ValueError(
                f"the experiments have times in different units ({', '.join(sorted(units))}), and one column of the "
                "CSV file would mix them: give each its own problem file."
            )
        (unit,) = units
        _make_folder(out.parent)

        text = io.StringIO()
        table = csv.writer(text, lineterminator="\r\n")
        table.writerow(["experiment", "t" if unit == "s" else f"t ({unit})", "mode", *runs[0].state_names])
        for k, run in enumerate(runs):
            name = loaded.problem.experiments[k].name or f"run{k + 1}"
            for t, mode, x in zip(run.times.tolist(), run.modes, run.states.tolist(), strict=True):
                table.writerow([name, t, mode, *x])
        _write(out, text.getvalue())


@app.command()
def rerun(
    saved: Annotated[
        Path, typer.Argument(metavar="ESTIMATE.json", help="Written by switchfit fit --out.", show_default=False)
    ],
    folder: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Where data and models are.", show_default="where they were, seen from ESTIMATE.json"
        ),
    ] = None,
    debug: Debug = False,
) -> None:
    """Fit again what a saved estimate was made from, and compare the answers.

    The problem is the one that was saved with the estimate; data and models are read from where they were. What has
    changed since, by its hash or its version, is said first. Exit code 0: the answer is the same; 1: it is another one;
    2: it cannot be run again.
    """
    with _report_errors(debug):
        from switchfit.io.rerun import compare_fits, prepare_rerun

        prepared = prepare_rerun(saved, folder)
        if prepared.changes:
            _print("\n".join(["Changed since", *(f"  {change}" for change in prepared.changes), ""]))
        estimate = _estimate(prepared.loaded, prepared.loaded.options, prepare_figures=False)
        answers = compare_fits(prepared, estimate)
        _print(answers)
    if not answers.same:
        raise typer.Exit(NOT_CONVERGED)


@app.command()
def paper(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for figures, results.json and table.md.")] = Path(
        "paper"
    ),
    quick: Annotated[bool, typer.Option("--quick", help="Fewer repetitions: two minutes instead of fifteen.")] = False,
    only: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="One part: lti, magic-formula, convergence, noise, trials or horizon.",
            show_default=False,
        ),
    ] = None,
    debug: Debug = False,
) -> None:
    """Reproduce every experiment and figure of Miller and Murphey's paper, and compare its numbers with ours.

    An interrupted run resumes when the same command is run again.
    """
    os.environ.setdefault("MPLBACKEND", "Agg")
    with _report_errors(debug):
        from switchfit.paper import run
        from switchfit.paper.runner import TABLE
        from switchfit.runtime.errors import InputError

        _make_folder(out)
        try:
            run(out, quick=quick, only=only, say=lambda text: _print(text, err=True))
        except KeyboardInterrupt:
            _fail("interrupted; run the same command again to resume.", INTERRUPTED)
        except OSError as error:
            raise InputError(f"{out} cannot be written: {error.strerror}; name another with --out.") from error
        _print((out / TABLE).read_text(encoding="utf-8"))
        _print(f"written to {out}", err=True)


# --- output -----------------------------------------------------------------------------------------------------------


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


class _CtrlC(KeyboardInterrupt):
    """Ctrl-C at the keyboard, and not a KeyboardInterrupt that a model file raises."""


def _interrupt(number: int, frame: FrameType | None) -> NoReturn:
    raise _CtrlC


@contextlib.contextmanager
def _report_errors(debug: bool) -> Iterator[None]:
    """Turn exceptions into a sentence on stderr and an exit code, including any exception of a model file."""
    try:
        with _handle_interrupt(_interrupt):
            yield
    except BaseException as error:
        from switchfit.io.python_file import find_user_place

        users = find_user_place(error) is not None
        if isinstance(error, typer.Exit) and not users:
            raise
        if debug:
            traceback.print_exc()
        if isinstance(error, _CtrlC) or (isinstance(error, KeyboardInterrupt) and not users):
            _fail("interrupted before there was anything to write.", INTERRUPTED)
        if not (users or isinstance(error, Exception)):
            raise
        _explain(error, users=users, debug=debug)


def _explain(error: BaseException, *, users: bool, debug: bool) -> NoReturn:
    """Print the error and exit; `users` is whether it was raised in a file of the user."""
    from switchfit.io.python_file import describe_error
    from switchfit.runtime.errors import InputError

    if users and not isinstance(error, InputError):
        _fail(f"{describe_error(error)}. (--debug shows the full traceback.)", BAD_INPUT)
    if isinstance(error, (ValueError, OSError)):
        _fail(str(error), BAD_INPUT)
    if isinstance(error, MemoryError):
        _fail(f"not enough memory: {str(error) or 'the problem is too large'}.", BAD_INPUT)
    if not debug:
        traceback.print_exception(error)
    _fail("this is an error in switchfit itself; please report it with the lines above.", INTERNAL_ERROR)


@contextlib.contextmanager
def _handle_interrupt(handler: Callable[[int, FrameType | None], object]) -> Iterator[None]:
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


def _fail(message: str, code: int) -> NoReturn:
    _print(f"switchfit: {message}", err=True)
    raise typer.Exit(code)


# --- a fit on the terminal --------------------------------------------------------------------------------------------


def _load(problem: Path) -> ProblemFile:
    from switchfit.io.problem_file import load_problem

    return load_problem(problem)


def _print_issues(issues: Sequence[Issue]) -> None:
    """Print what is odd about logs."""
    if issues:
        _print("\n".join(["Logs", *(f"  {issue}" for issue in issues), ""]))


def _fail_for_refused(issues: Sequence[Issue]) -> None:
    """Name the logs that could not be used, and end with the exit code that says so."""
    refused = [issue for issue in issues if issue.kind == "log: refused"]
    for issue in refused:
        _print(f"switchfit: {issue}", err=True)
    if refused:
        raise typer.Exit(BAD_INPUT)


def _check_files(problem: Path) -> None:
    """Print the parts of a problem that are known without running a Python file."""
    from switchfit.io.problem_file import read_experiments
    from switchfit.io.summary import describe_experiments

    runs = read_experiments(problem)
    if runs.experiments:
        _print(f"{describe_experiments(runs.experiments)}\n")
        _print_issues(runs.issues)
    _print("No Python file was run: modes, states, functions and names of parameters are not checked.")
    _fail_for_refused(runs.issues)


def _estimate(loaded: ProblemFile, options: dict[str, Any], *, prepare_figures: bool) -> Any:
    """Call `switchfit.estimate`, which shows a line on a terminal; Ctrl-C ends a fit after the current iteration."""
    import switchfit as sf

    if prepare_figures:  # matplotlib, which must not look for a display, loads while XLA compiles
        os.environ.setdefault("MPLBACKEND", "Agg")
        threading.Thread(target=_import_figures, daemon=True).start()
    with _stop_on_interrupt() as stopped:
        return sf.estimate(loaded.problem, callback=lambda record: stopped(), **options)


def _choose_tables(estimate: Any, out: Path | None) -> dict[str, Path]:
    """Return the CSV files for what a screen of the report has no room for."""
    from switchfit.report.text import SCREEN

    counts = {"runs": len(estimate.run_names), "unknowns": len(estimate.theta)}
    most = {"runs": SCREEN.experiments, "unknowns": SCREEN.unknowns}
    return {} if out is None else {name: out / f"{name}.csv" for name in counts if counts[name] > most[name]}


def _write_tables(estimate: Any, tables: dict[str, Path]) -> None:
    from switchfit.io.result_tables import write_runs, write_unknowns

    writers = {"runs": write_runs, "unknowns": write_unknowns}
    for name, path in tables.items():
        _write(path, writers[name](estimate))


def _write_report(estimate: Any, full: bool, tables: dict[str, Path]) -> str:
    from switchfit.runtime.presentation import format_text

    return str(format_text(estimate, full=full, files={name: str(path) for name, path in tables.items()}))


@dataclass(frozen=True)
class _Output:
    """What is printed of a fit, and written; the format of the figure, empty for none."""

    folder: Path | None
    figures: str
    certificate: bool
    full: bool


def _write_estimate(
    estimate: Any,
    loaded: ProblemFile,
    options: dict[str, Any],
    output: _Output,
    folder: Path | None,
    *,
    show: bool = True,
) -> None:
    """Print the report, and write report, page, estimate and figure into a folder."""
    checked = f"\n\nCertificate\n{estimate.certificate}" if output.certificate else ""
    tables = _choose_tables(estimate, folder)
    # The report after the certificate, which is part of the verdict.
    report = _write_report(estimate, output.full, tables) + checked
    if show:
        _print(report)
    if folder is None:
        return
    _write(folder / "report.txt", report + "\n")
    _write_tables(estimate, tables)
    with _explain_write_errors(folder / "estimate.json") as path:
        provenance = estimate.describe_provenance(replace(loaded.provenance, options=options))
        _save(estimate, path, provenance, complete=output.certificate)
    if output.figures:
        figure = io.BytesIO()
        estimate.plot().savefig(figure, format=output.figures, dpi=150)
        _write(folder / f"fit.{output.figures}", figure.getvalue())
        _write_page(estimate, loaded, options, folder / "report.html")
    _print(f"written to {folder}", err=True)


def _fit_logs(paths: list[Path], model: Path, overrides: dict[str, Any], output: _Output, table: Path | None) -> int:
    """Fit logs one by one, print a line for each, and return the exit code of the worst."""
    from switchfit.io.log_table import ResultTable, check_table, list_logs, load_log

    logs = list_logs(paths)
    if table is not None:
        check_table(table)
        _make_folder(table.parent)
    results = ResultTable()
    for name, path in logs:
        loaded, error = load_log(model, path)
        estimate = None
        if loaded is not None:
            estimate, error = _estimate_log(loaded, overrides, output)
        results.add(str(path), estimate, error)
        _print(results.describe_last())
        if loaded is not None and estimate is not None and output.folder is not None:
            _make_folder(output.folder / name)
            options = loaded.options | overrides
            _write_estimate(estimate, loaded, options, output, output.folder / name, show=False)
        if table is not None:  # after each log, so that an interrupted run leaves what it has
            _write(table, results.write(table))
        if estimate is not None and estimate.status.name == "INTERRUPTED":
            break
    _print(results.summarize(len(logs)), err=True)
    return BAD_INPUT if results.refused else NOT_CONVERGED if results.failed or len(results) < len(logs) else CONVERGED


def _estimate_log(loaded: ProblemFile, overrides: dict[str, Any], output: _Output) -> tuple[Any, str]:
    """Return the estimate for a log, or None and what is wrong."""
    from switchfit.io.python_file import describe_error

    try:
        return _estimate(loaded, loaded.options | overrides, prepare_figures=bool(output.figures)), ""
    except Exception as error:
        return None, describe_error(error)


def _import_figures() -> None:
    with contextlib.suppress(ImportError):
        import matplotlib.backends.backend_agg
        import matplotlib.figure  # noqa: F401


def _save(estimate: Any, path: Path, provenance: Any, *, complete: bool) -> None:
    """Save an estimate; unless `complete`, its certificate omits the paper's equations, which take seconds."""
    from switchfit.estimation.saved import save_fit
    from switchfit.uncertainty.certificate import certify

    certificate = estimate.certificate if complete else certify(estimate, None)
    save_fit(estimate.complete(), certificate, path, provenance)


def _write_page(estimate: Any, loaded: ProblemFile, options: dict[str, Any], path: Path) -> None:
    """Write the report as an HTML file; without the libraries that it needs, say how to install them."""
    from switchfit.runtime.errors import MissingExtraError
    from switchfit.runtime.presentation import format_page

    try:
        page = format_page(estimate, problem_file=loaded.path, options=options)
    except MissingExtraError as missing:
        _print(f"no {path.name}: {missing}", err=True)
    else:
        _write(path, page)


@contextlib.contextmanager
def _stop_on_interrupt() -> Iterator[Callable[[], bool]]:
    """Return a context in which the first Ctrl-C requests a stop, and the second raises KeyboardInterrupt.

    During a search with strategies, which no callback can stop, the first one raises it: the search keeps its best fit.
    """
    from switchfit.strategy.choice import is_searching

    requested = threading.Event()

    def request(number: int, frame: FrameType | None) -> None:
        if requested.is_set() or is_searching():
            requested.set()
            raise _CtrlC
        requested.set()
        _print("stopping after this iteration; Ctrl-C again to stop at once", err=True)

    with _handle_interrupt(request):
        yield requested.is_set


# --- files ------------------------------------------------------------------------------------------------------------


def _make_folder(folder: Path) -> None:
    from switchfit.runtime.errors import InputError

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"the folder {folder} cannot be created: {error.strerror}; name another with --out."
        ) from error


@contextlib.contextmanager
def _explain_write_errors(path: Path) -> Iterator[Path]:
    """Return a context that turns an OSError into an InputError with the name of the file and the reason."""
    from switchfit.runtime.errors import InputError

    try:
        yield path
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror}; name another with --out.") from error


def _write(path: Path, content: str | bytes) -> None:
    """Write a file atomically."""
    from switchfit.runtime.files import write_atomically

    with _explain_write_errors(path):
        write_atomically(content, path)
