"""``switchfit fit``: one problem, or many logs with one problem file."""

from __future__ import annotations

import contextlib
import io
import os
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from switchfit.cli.app import Debug, fail_for_refused, load
from switchfit.cli.terminal import (
    BAD_INPUT,
    CONVERGED,
    NOT_CONVERGED,
    explain_write_errors,
    fail,
    make_folder,
    print_text,
    report_errors,
    stop_on_interrupt,
    write_file,
)

if TYPE_CHECKING:
    from switchfit.io.problem_file import ProblemFile


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
        typer.Option(metavar="FILE.csv", help="With --problem: a line for each log.", show_default=False),
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
    no_figures: Annotated[
        bool, typer.Option("--no-figures", help="Write no figures: neither fit.png nor report.html.")
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
    output = Output(out, figures=out is not None and not no_figures, certificate=certificate, full=full)
    if model is not None:
        with report_errors(debug):
            code = _fit_logs(problem, model, overrides, output, table)
        if code != CONVERGED:
            raise typer.Exit(code)
        return
    if len(problem) != 1 or table is not None:
        fail("name one problem file; to fit several logs by one, name it with --problem PROBLEM.toml.", BAD_INPUT)
    with report_errors(debug):
        loaded = load(problem[0])
        if out is not None:
            make_folder(out)
        options = loaded.options | overrides
        estimate = estimate_problem(loaded, options, prepare_figures=output.figures)
        write_estimate(estimate, loaded, options, output, output.folder)
    fail_for_refused(loaded.issues)
    if not estimate.success:
        reason = "" if estimate.status.successful else f"not converged. {estimate.message}"
        print_text(f"switchfit: {reason or 'the fit is bad; the first line of the report says why.'}", err=True)
        raise typer.Exit(NOT_CONVERGED)


def estimate_problem(loaded: ProblemFile, options: dict[str, Any], *, prepare_figures: bool) -> Any:
    """Call `switchfit.estimate`, which shows a line on a terminal; Ctrl-C ends a fit after the current iteration."""
    import switchfit as sf

    if prepare_figures:  # matplotlib, which must not look for a display, loads while XLA compiles
        os.environ.setdefault("MPLBACKEND", "Agg")
        threading.Thread(target=_import_figures, daemon=True).start()
    with stop_on_interrupt() as stopped:
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
        write_file(path, writers[name](estimate))


def _write_report(estimate: Any, full: bool, tables: dict[str, Path]) -> str:
    from switchfit.runtime.presentation import format_text

    return str(format_text(estimate, full=full, files={name: str(path) for name, path in tables.items()}))


@dataclass(frozen=True)
class Output:
    """What is printed of a fit, and written."""

    folder: Path | None
    figures: bool
    certificate: bool
    full: bool


def write_estimate(
    estimate: Any,
    loaded: ProblemFile,
    options: dict[str, Any],
    output: Output,
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
        print_text(report)
    if folder is None:
        return
    write_file(folder / "report.txt", report + "\n")
    _write_tables(estimate, tables)
    with explain_write_errors(folder / "estimate.json") as path:
        _save(estimate, path, complete=output.certificate)
    if output.figures:
        figure = io.BytesIO()
        estimate.plot().savefig(figure, format="png", dpi=150)
        write_file(folder / "fit.png", figure.getvalue())
        _write_page(estimate, loaded, options, folder / "report.html")
    print_text(f"written to {folder}", err=True)


def _fit_logs(paths: list[Path], model: Path, overrides: dict[str, Any], output: Output, table: Path | None) -> int:
    """Fit logs one by one, print a line for each, and return the exit code of the worst."""
    from switchfit.io.log_table import ResultTable, list_logs, load_log

    logs = list_logs(paths)
    if table is not None:
        make_folder(table.parent)
    results = ResultTable()
    for name, path in logs:
        loaded, error = load_log(model, path)
        estimate = None
        if loaded is not None:
            estimate, error = _estimate_log(loaded, overrides, output)
        results.add(str(path), estimate, error)
        print_text(results.describe_last())
        if loaded is not None and estimate is not None and output.folder is not None:
            make_folder(output.folder / name)
            options = loaded.options | overrides
            write_estimate(estimate, loaded, options, output, output.folder / name, show=False)
        if table is not None:  # after each log, so that an interrupted run leaves what it has
            write_file(table, results.write())
        if estimate is not None and estimate.status.name == "INTERRUPTED":
            break
    print_text(results.summarize(len(logs)), err=True)
    return BAD_INPUT if results.refused else NOT_CONVERGED if results.failed or len(results) < len(logs) else CONVERGED


def _estimate_log(loaded: ProblemFile, overrides: dict[str, Any], output: Output) -> tuple[Any, str]:
    """Return the estimate for a log, or None and what is wrong."""
    from switchfit.io.python_file import describe_error

    try:
        return estimate_problem(loaded, loaded.options | overrides, prepare_figures=output.figures), ""
    except Exception as error:
        return None, describe_error(error)


def _import_figures() -> None:
    with contextlib.suppress(ImportError):
        import matplotlib.backends.backend_agg
        import matplotlib.figure  # noqa: F401


def _save(estimate: Any, path: Path, *, complete: bool) -> None:
    """Save an estimate; unless `complete`, its certificate omits the paper's equations, which take seconds."""
    from switchfit.estimation.saved import save_fit
    from switchfit.uncertainty.certificate import certify

    save_fit(estimate.complete(), estimate.certificate if complete else certify(estimate, None), path)


def _write_page(estimate: Any, loaded: ProblemFile, options: dict[str, Any], path: Path) -> None:
    """Write the report as an HTML file; without the libraries that it needs, say how to install them."""
    from switchfit.runtime.errors import MissingExtraError
    from switchfit.runtime.presentation import format_page

    try:
        page = format_page(estimate, problem_file=loaded.path, options=options)
    except MissingExtraError as missing:
        print_text(f"no {path.name}: {missing}", err=True)
    else:
        write_file(path, page)
