"""``switchfit fit``: fit one problem, or many logs one by one."""

from __future__ import annotations

import contextlib
import os
import threading
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

import switchfit as sf
from switchfit.cli import command, errors, files, interrupts, terminal
from switchfit.cli import options as options_module
from switchfit.cli.options import argument, option, output_folder
from switchfit.io.user_files import describe_error
from switchfit.runtime.errors import InputError
from switchfit.runtime.extras import MissingExtraError
from switchfit.runtime.files import write_atomically
from switchfit.runtime.presentation import format_count, format_page, format_text

if TYPE_CHECKING:
    from switchfit.estimation.estimates import Estimate
    from switchfit.io.problem_file.building import ProblemFile
    from switchfit.io.provenance import Provenance
    from switchfit.optimize.result import IterationRecord

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


@command.command("json", "quiet", "verbose")
def fit(
    problem: Problems,
    out: OutputFolder = None,
    model: ProblemForLogs = None,
    table: LogTable = None,
    strategy: Strategy = None,
    hessian: HessianKind = None,
    max_iterations: MaxIterations = None,
    figures: options_module.FigureFormat = "png",
    no_figures: NoFigures = False,
    certificate: WithCertificate = False,
    full: Full = False,
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
    # What is not given stays as the file has it.
    overrides = options_module.select_given(strategy=strategy, hessian=hessian, max_iterations=max_iterations)
    # Without a folder there is nowhere to write them: matplotlib is then not even imported.
    drawn = "" if out is None or no_figures else figures
    output = Output(out, figures=drawn, certificate=certificate, full=full)
    if model is not None:
        raise typer.Exit(_fit_logs(problem, model, overrides, output, table))
    # Several files without --problem are most likely logs whose problem file was forgotten.
    if len(problem) != 1 or table is not None:
        errors.fail("name one problem file; to fit several logs by one, name it with --problem PROBLEM.toml.")
    loaded = _override(files.load(problem[0], out), overrides)
    estimate = estimate_problem(loaded, prepare_figures=bool(output.figures))
    write_estimate(estimate, loaded, output)
    from switchfit.cli.summaries import summarize_estimate

    terminal.print_json(summarize_estimate(estimate) | {"out": out})
    # The order of the exit codes: wrong input first, then a fit that did not converge, then one that did but is bad.
    errors.fail_for_refused(loaded.issues)
    if not estimate.status.successful:
        errors.end_unreliable(f"not converged. {estimate.message}")
    if not estimate.success:
        errors.end_unreliable("the fit is bad; the first line of the report says why.")


def _override(loaded: ProblemFile, options: dict[str, Any]) -> ProblemFile:
    return replace(loaded, options=loaded.options | options)


def estimate_problem(loaded: ProblemFile, *, prepare_figures: bool) -> Estimate:
    """Call `switchfit.estimate`, which shows a line on a terminal; Ctrl-C ends a fit after the current iteration."""
    importing = threading.Thread(target=_import_figures, daemon=True)
    if prepare_figures:  # matplotlib, which must not look for a display, and Bokeh load while LLVM compiles
        os.environ.setdefault("MPLBACKEND", "Agg")
        importing.start()
    with interrupts.stop_on_interrupt(_describe_iteration) as report:
        estimate = sf.estimate(loaded.problem, callback=report, **loaded.options)
    if prepare_figures:
        importing.join()  # two threads that import modules of one package in different orders find some half made
    if terminal.is_asked("verbose"):
        terminal.print_note(estimate.engine)
        for step in estimate.steps:
            terminal.print_note(f"{step.strategy}: lowest J = {step.cost:.6g} after {step.seconds:.2g} s")
        counts = f"{estimate.iterations} iterations, {estimate.evaluations} evaluations"
        terminal.print_note(f"{counts}, {estimate.seconds:.2g} s")
    return estimate


def _describe_iteration(record: IterationRecord) -> str:
    return f"iteration {record.iteration}: J = {record.cost:.6g}, optimality {record.optimality:.1e}"


@dataclass(frozen=True)
class Output:
    """What is printed of a fit, and written; the format of the figure, empty for none."""

    folder: Path | None
    figures: str
    certificate: bool
    full: bool


def write_estimate(estimate: Estimate, loaded: ProblemFile, output: Output, *, show: bool = True) -> None:
    """Print the report, and write report, page, estimate and figure into a folder."""
    from switchfit.cli.tables import list_tables

    checked = f"\n\nCertificate\n{estimate.certificate}" if output.certificate else ""
    # The report after the certificate, which is part of the verdict.
    report, folder = f"{format_text(estimate, full=output.full)}{checked}", output.folder
    if show:
        terminal.print_text(report)
    if folder is None:
        return
    write_atomically(report + "\n", folder / "report.txt")
    for name, table in list_tables(estimate).items():
        write_atomically(table, folder / f"{name}.csv")
    # With the options as they were overridden: the same call can be made again.
    provenance = estimate.describe_provenance(replace(loaded.provenance, options=loaded.options))
    _save(estimate, folder / "estimate.json", provenance, complete=output.certificate)
    if output.figures:
        files.write_figure(estimate, folder / f"fit.{output.figures}")
        _write_page(estimate, provenance, folder / "report.html")
    terminal.print_note(f"written to {folder}")


def _fit_logs(paths: list[Path], model: Path, overrides: dict[str, Any], output: Output, table: Path | None) -> int:
    """Fit logs one by one, print a line for each, and return the exit code of the worst."""
    from switchfit.cli.many_logs import check_table, describe_fit, describe_row, list_logs, write_logs
    from switchfit.cli.summaries import summarize_estimate

    logs = list_logs(paths)
    if table is not None:
        check_table(table)
        files.make_folder(table.parent)
    rows: list[dict[str, Any]] = []
    fitted = []
    for name, path in logs:
        # A folder for each log, by the name that tells it from the others.
        folder = None if output.folder is None else output.folder / name
        estimate, error = None, ""
        try:
            loaded = _override(files.load(model, log=path), overrides)
            estimate = estimate_problem(loaded, prepare_figures=bool(output.figures))
        # Anything that a log or a model file does: the next log may be good.
        except Exception as raised:
            error = str(raised) if isinstance(raised, InputError) else describe_error(raised)
        rows.append(describe_fit(str(path), estimate, error))
        terminal.print_text(describe_row(rows[-1]))
        shown = rows[-1] if estimate is None else summarize_estimate(estimate) | {"out": folder}
        fitted.append({"log": str(path)} | shown)
        if estimate is not None and folder is not None:
            files.make_folder(folder)
            write_estimate(estimate, loaded, replace(output, folder=folder), show=False)
        if table is not None:  # after each log, so that an interrupted run leaves what it has
            write_atomically(write_logs(rows, table), table)
        if estimate is not None and estimate.status.name == "INTERRUPTED":
            break
    # A row with a message is refused, or was fitted and is not converged or bad.
    refused = sum(row["verdict"] == "refused" for row in rows)
    failed, left = sum(bool(row["message"]) for row in rows) - refused, len(logs) - len(rows)
    counts = f"{len(rows) - refused - failed} fitted, {failed} not, {refused} refused"
    terminal.print_note(f"{format_count(len(logs), 'log')}: {counts}{f'; {left} were not begun' if left else ''}")
    terminal.print_json({"logs": fitted})
    if refused:
        return errors.EXIT_BAD_INPUT
    return errors.EXIT_NOT_CONVERGED if failed or left else errors.EXIT_CONVERGED


def _import_figures() -> None:
    with contextlib.suppress(ImportError):
        import matplotlib.backends.backend_agg
        import matplotlib.figure  # noqa: F401

        import switchfit.report.html.page  # noqa: F401  # with Bokeh and Jinja2


def _save(estimate: Estimate, path: Path, provenance: Provenance | None, *, complete: bool) -> None:
    """Save an estimate; unless `complete`, its certificate omits the paper's equations, which take seconds."""
    from switchfit.io.saved_fits import save_fit
    from switchfit.uncertainty.certificate import certify

    # Without an evaluator, `certify` checks all but the paper's equations.
    certificate = estimate.certificate if complete else certify(estimate, None)
    save_fit(estimate.complete(), certificate, path, provenance)


def _write_page(estimate: Estimate, provenance: Provenance | None, path: Path) -> None:
    """Write the report as an HTML file; without the libraries that it needs, say how to install them."""
    try:
        page = format_page(estimate, provenance=provenance)
    except MissingExtraError as missing:
        terminal.print_note(f"no {path.name}: {missing}")
    else:
        write_atomically(page, path)
