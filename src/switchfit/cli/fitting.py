"""``switchfit fit``: one problem, or many logs with one problem file."""

from __future__ import annotations

import contextlib
import os
import threading
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from switchfit.cli import terminal
from switchfit.cli.terminal import argument, option, output_folder

if TYPE_CHECKING:
    from switchfit.io.problem_file.building import ProblemFile


Problems = Annotated[
    list[Path], argument("PROBLEM.toml", "Problem file; with --problem, logs, each of which is fitted by itself.")
]
OutputFolder = Annotated[
    Path | None, output_folder("report.html, report.txt, estimate.json, fit.png, and tables of many runs or unknowns")
]
ProblemForLogs = Annotated[
    Path | None, option("--problem", metavar="PROBLEM.toml", help="Problem file for the logs that are named.")
]
LogTable = Annotated[
    Path | None, option(metavar="FILE.csv", help="With --problem: a table with a row for each log; FILE.parquet too.")
]
Strategy = Annotated[
    Literal["local", "auto", "thorough"] | None,
    option(help="local: one fit; auto, the default: more if the verdict is not good; thorough: all strategies."),
]
HessianKind = Annotated[
    Literal["auto", "exact", "descent-first", "block-diagonal", "gauss-newton", "none"] | None,
    option(help="Quadratic term of the optimizer. Default: auto, the exact Hessian in a trust region."),
]
MaxIterations = Annotated[int | None, option(metavar="COUNT", help="Most iterations of a fit. Default: 200.")]
NoFigures = Annotated[bool, typer.Option("--no-figures", help="Write neither fit.png (.pdf, .svg) nor report.html.")]
WithCertificate = Annotated[bool, typer.Option("--certificate", help="Print the checks, with the paper's equations.")]
Full = Annotated[bool, typer.Option("--full", help="Report all runs, channels, unknowns and warnings, not one screen.")]


def fit(
    problem: Problems,
    out: OutputFolder = None,
    model: ProblemForLogs = None,
    table: LogTable = None,
    strategy: Strategy = None,
    hessian: HessianKind = None,
    max_iterations: MaxIterations = None,
    figures: terminal.FigureFormat = "png",
    no_figures: NoFigures = False,
    certificate: WithCertificate = False,
    full: Full = False,
    json: terminal.Json = False,
    quiet: terminal.Quiet = False,
    verbose: terminal.Verbose = False,
    debug: terminal.Debug = False,
) -> None:
    """Estimate transition times and parameters, and report.

    The report goes to the terminal, and with --out into a folder, with a page and a figure. Options override those in
    the problem file. Ctrl-C stops after the current iteration and reports the result so far.

    Exit code 0: converged, and the verdict is good or doubtful. 1: not converged or bad; the result is still written.
    2: the input is wrong.

    LOG ... --problem PROBLEM.toml fits each log by itself, in place of the file that the data name. A pattern or a
    folder stands for the logs in it. A log that cannot be used is reported, and the next one is fitted; the exit code
    is that of the worst.
    """
    overrides = terminal.select_given(strategy=strategy, hessian=hessian, max_iterations=max_iterations)
    drawn = "" if out is None or no_figures else figures
    output = Output(out, figures=drawn, certificate=certificate, full=full)
    with terminal.report_errors(debug, json=json, quiet=quiet, verbose=verbose):
        if model is not None:
            raise typer.Exit(_fit_logs(problem, model, overrides, output, table))
        if len(problem) != 1 or table is not None:
            terminal.fail("name one problem file; to fit several logs by one, name it with --problem PROBLEM.toml.")
        from switchfit.io.problem_file import load_problem

        loaded = load_problem(problem[0])
        terminal.make_folder(out)
        options = loaded.options | overrides
        estimate = estimate_problem(loaded, options, prepare_figures=bool(output.figures))
        write_estimate(estimate, loaded, options, output)
        from switchfit.io.command_line import summarize_estimate
        from switchfit.report.formats import add_dates

        terminal.print_json(summarize_estimate(estimate) | {"out": out})
        terminal.fail_for_refused(loaded.issues)
        if not estimate.status.successful:
            terminal.end_unreliable(f"not converged. {add_dates(estimate.message, estimate)}")
        if not estimate.success:
            terminal.end_unreliable("the fit is bad; the first line of the report says why.")


def estimate_problem(loaded: ProblemFile, options: dict[str, Any], *, prepare_figures: bool) -> Any:
    """Call `switchfit.estimate`, which shows a line on a terminal; Ctrl-C ends a fit after the current iteration."""
    import switchfit as sf

    importing = threading.Thread(target=_import_figures, daemon=True)
    if prepare_figures:  # matplotlib, which must not look for a display, loads while LLVM compiles
        os.environ.setdefault("MPLBACKEND", "Agg")
        importing.start()
    with terminal.stop_on_interrupt(
        lambda r: f"iteration {r.iteration}: J = {r.cost:.6g}, optimality {r.optimality:.1e}"
    ) as report:
        estimate = sf.estimate(loaded.problem, callback=report, **options)
    if prepare_figures:
        importing.join()  # two threads that import modules of one package in different orders find some half made
    if terminal.is_verbose():
        terminal.print_note(estimate.engine)
        for step in estimate.steps:
            terminal.print_note(f"{step.strategy}: lowest J = {step.cost:.6g} after {step.seconds:.2g} s")
        counts = f"{estimate.iterations} iterations, {estimate.evaluations} evaluations"
        terminal.print_note(f"{counts}, {estimate.seconds:.2g} s")
    return estimate


def _choose_tables(estimate: Any, folder: Path | None) -> dict[str, Path]:
    """Return the CSV files for what a screen of the report has no room for."""
    from switchfit.report.text import SCREEN

    counts = {"runs": len(estimate.run_names), "unknowns": len(estimate.theta)}
    is_long = {"runs": counts["runs"] > SCREEN["experiments"], "unknowns": counts["unknowns"] > SCREEN["unknowns"]}
    return {} if folder is None else {name: folder / f"{name}.csv" for name in is_long if is_long[name]}


@dataclass(frozen=True)
class Output:
    """What is printed of a fit, and written; the format of the figure, empty for none."""

    folder: Path | None
    figures: str
    certificate: bool
    full: bool


def write_estimate(
    estimate: Any,
    loaded: ProblemFile,
    options: dict[str, Any],
    output: Output,
    *,
    show: bool = True,
) -> None:
    """Print the report, and write report, page, estimate and figure into a folder."""
    from switchfit.io.result_tables import TABLES
    from switchfit.report.formats import add_dates
    from switchfit.runtime.presentation import format_text

    checked = f"\n\nCertificate\n{add_dates(str(estimate.certificate), estimate)}" if output.certificate else ""
    folder, tables = output.folder, _choose_tables(estimate, output.folder)
    # The report after the certificate, which is part of the verdict.
    files = {name: str(path) for name, path in tables.items()}
    report = f"{format_text(estimate, full=output.full, files=files)}{checked}"
    if show:
        terminal.print_text(report)
    if folder is None:
        return
    terminal.write_file(folder / "report.txt", report + "\n")
    for name, path in tables.items():
        terminal.write_file(path, TABLES[name](estimate))
    provenance = estimate.describe_provenance(replace(loaded.provenance, options=options))
    _save(estimate, folder / "estimate.json", provenance, complete=output.certificate)
    if output.figures:
        terminal.write_figure(estimate, folder / f"fit.{output.figures}")
        _write_page(estimate, provenance, folder / "report.html")
    terminal.print_note(f"written to {folder}")


def _fit_logs(paths: list[Path], model: Path, overrides: dict[str, Any], output: Output, table: Path | None) -> int:
    """Fit logs one by one, print a line for each, and return the exit code of the worst."""
    from switchfit.io.command_line import summarize_estimate
    from switchfit.io.result_tables import ResultTable, check_table, list_logs

    logs = list_logs(paths)
    if table is not None:
        check_table(table)
        terminal.make_folder(table.parent)
    results, fitted = ResultTable(), []
    for name, path in logs:
        loaded, estimate, error = _fit_log(model, path, overrides, output)
        results.add(str(path), estimate, error)
        terminal.print_text(results.describe_last())
        folder = None if output.folder is None else output.folder / name
        refused = {"verdict": "refused", "message": error}
        shown = refused if estimate is None else summarize_estimate(estimate) | {"out": folder}
        fitted.append({"log": str(path)} | shown)
        if loaded is not None and folder is not None:
            terminal.make_folder(folder)
            write_estimate(estimate, loaded, loaded.options | overrides, replace(output, folder=folder), show=False)
        if table is not None:  # after each log, so that an interrupted run leaves what it has
            terminal.write_file(table, results.write(table))
        if estimate is not None and estimate.status.name == "INTERRUPTED":
            break
    terminal.print_note(results.summarize(len(logs)))
    terminal.print_json({"logs": fitted})
    if results.refused:
        return terminal.BAD_INPUT
    return terminal.NOT_CONVERGED if results.failed or len(results) < len(logs) else terminal.CONVERGED


def _fit_log(model: Path, log: Path, overrides: dict[str, Any], output: Output) -> tuple[ProblemFile | None, Any, str]:
    """Return the problem of a log and its estimate, or None for both, and what is wrong."""
    from switchfit.io.problem_file import load_problem
    from switchfit.io.user_files import describe_error
    from switchfit.runtime.errors import InputError

    try:
        loaded = load_problem(model, log)
        return loaded, estimate_problem(loaded, loaded.options | overrides, prepare_figures=bool(output.figures)), ""
    except Exception as error:
        return None, None, str(error) if isinstance(error, InputError) else describe_error(error)


def _import_figures() -> None:
    with contextlib.suppress(ImportError):
        import matplotlib.backends.backend_agg
        import matplotlib.figure  # noqa: F401

        import switchfit.report.html.page  # noqa: F401  # with Jinja2


def _save(estimate: Any, path: Path, provenance: Any, *, complete: bool) -> None:
    """Save an estimate; unless `complete`, its certificate omits the paper's equations, which take seconds."""
    from switchfit.estimation.saved import save_fit
    from switchfit.uncertainty.certificate import certify

    certificate = estimate.certificate if complete else certify(estimate, None)
    save_fit(estimate.complete(), certificate, path, provenance)


def _write_page(estimate: Any, provenance: Any, path: Path) -> None:
    """Write the report as an HTML file; without the libraries that it needs, say how to install them."""
    from switchfit.runtime.errors import MissingExtraError
    from switchfit.runtime.presentation import format_page

    try:
        page = format_page(estimate, provenance=provenance)
    except MissingExtraError as missing:
        terminal.print_note(f"no {path.name}: {missing}")
    else:
        terminal.write_file(path, page)
