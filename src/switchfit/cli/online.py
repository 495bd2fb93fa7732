"""``switchfit online``: estimate sample by sample, from a log or from stdin."""

from __future__ import annotations

import contextlib
import math
import signal
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import switchfit as sf
from switchfit.cli import command, errors, files, interrupts, options, terminal
from switchfit.cli.options import option, output_folder
from switchfit.runtime.presentation import format_count

if TYPE_CHECKING:
    from switchfit.cli.live_page import LivePage
    from switchfit.io.problem_file.building import ProblemFile
    from switchfit.online.estimator import OnlineEstimator
    from switchfit.online.state import Now

LEAST_ROOM = 4096
"""Times for which there is room, if the log has not more."""

REFUSED = (ValueError, TypeError, OverflowError)
"""Errors of a sample that is not taken; those after it are."""

Replayed = Annotated[
    Path | None, typer.Option("--replay", metavar="LOG", help="Log to feed. Default: that of the problem file.")
]

Stdin = Annotated[
    bool, typer.Option("--stdin", help='Read samples from stdin, a line {"t": 0.1, "y": [1.2], "u": [0.3]} each.')
]

Window = Annotated[
    float | None,
    option(metavar="TIME", help="How long samples are kept. Default: that of the file, or all, up to 4096."),
]

FalseAlarms = Annotated[
    float | None,
    option(metavar="RATE", help="False alarms per time unit: finds the threshold by simulation, in a minute."),
]

Threshold = Annotated[float | None, option(metavar="NUMBER", help="Statistic at which to alarm. Default: 12.")]
Budget = Annotated[float | None, option(metavar="SECONDS", help="Most that an update may take. Default: no limit.")]
MaxSwitches = Annotated[int, option(metavar="COUNT", help="Most changes in the window, or in all. Default: 8.")]

StateFile = Annotated[
    Path | None, option("--state", metavar="FILE", help="Go on from this file, if it exists; save to it at the end.")
]

JournalFile = Annotated[
    Path | None, option("--journal", metavar="FILE", help="Write each sample to this file first: a crash loses none.")
]

Live = Annotated[
    int | None,
    option("--live", metavar="PORT", help="Show a page at http://127.0.0.1:PORT until Ctrl-C; 0: a free port."),
]


@command.command("quiet", "verbose")
def online(
    problem: options.ProblemPath,
    replay: Replayed = None,
    stdin: Stdin = False,
    window: Window = None,
    false_alarms: FalseAlarms = None,
    threshold: Threshold = None,
    max_switches: MaxSwitches = 8,
    budget: Budget = None,
    state: StateFile = None,
    journal: JournalFile = None,
    live: Live = None,
    out: Annotated[Path | None, output_folder("online.txt and online.png")] = None,
    figures: options.FigureFormat = "png",
) -> None:
    """Estimate while the samples come in: which mode is it now, since when, with which parameters?

    Prints a line of JSON for each sample. The samples are those of the log that the problem file names, of another one
    (--replay), or lines of stdin. The mode at t0 is the first of mode_sequence; the [library] of the file says which
    modes may follow, and [online] which parameters change. Ctrl-C ends the run and keeps what it has.

    Exit code 0: the model follows the samples. 1: at the end it does not. 2: the input is wrong, or was in some lines
    of stdin, which are reported and left out.
    """
    if stdin and replay is not None:
        errors.fail("--replay and --stdin contradict each other; give one of them.")
    loaded = files.load(problem, out, log=replay, searched=True, streamed=stdin)
    for issue in loaded.issues:
        terminal.print_note(issue)
    from switchfit.online.log import build_log
    from switchfit.strategy.library import build_library

    # Before the first sample: a folder that cannot be made must not lose what was estimated.
    for file in filter(None, (state, journal)):
        file.parent.mkdir(parents=True, exist_ok=True)
    sensors = loaded.problem.experiments[0].measurements
    # Nodes as well as samples need room, and between samples there may be nodes of the mesh.
    room = max(LEAST_ROOM, 2 * sum(len(item.times) for item in sensors))
    # Options override the table [online] of the file.
    settings = loaded.contents.online.model_dump(exclude_none=True) | options.select_given(window=window)
    settings |= {"max_switches": max_switches, "budget": budget, "capacity": room}
    library = build_library(loaded.problem, **loaded.library)  # modes that it leaves out never follow
    settings |= {"successions": library.successions, "min_duration": library.durations}
    estimator = _start(loaded, settings, {"threshold": threshold, "false_alarms": false_alarms}, state, journal)
    # The page outlives the samples, until Ctrl-C, and is closed on every way out.
    with contextlib.nullcontext() if live is None else _serve(loaded, live) as page:
        recorded, refused, interrupted = _run(loaded, estimator, stdin=stdin, page=page, records=out is not None)
        if estimator.now is None:
            errors.fail("there were no samples.")
        if state is not None:
            estimator.save(state)
        if out is not None and recorded:
            files.write_result(build_log(loaded.problem, recorded), out / "online", figures)
        if page is not None and not interrupted:
            with contextlib.suppress(interrupts.CtrlC):
                terminal.print_note("the samples have ended; Ctrl-C ends the page")
                page.wait()
    errors.fail_for_refused(loaded.issues)
    if refused:
        errors.fail(f"{format_count(refused, 'line')} of stdin could not be used.")
    if estimator.now.status.name == "LOST":
        errors.end_unreliable(f"{estimator.now.status.value}.")


def _start(
    loaded: ProblemFile, settings: dict[str, Any], alarms: dict[str, Any], state: Path | None, journal: Path | None
) -> OnlineEstimator:
    """Return the estimator: a new one, or that of a state and a journal."""
    if state is not None and state.exists():
        # Thresholds are those of the saved state; --threshold and --false-alarms are for a new one.
        estimator = sf.OnlineEstimator.load(state, loaded.problem, **settings)
    else:
        estimator = sf.OnlineEstimator(loaded.problem, **settings, **alarms)
    if journal is not None:
        estimator.keep_journal(journal)
    if estimator.now is not None:
        terminal.print_note(f"going on from t = {estimator.now.time:.6g}, with the threshold {estimator.threshold:.4g}")
    # A threshold that was found by simulation is worth knowing: with --threshold it need not be found again.
    elif alarms["false_alarms"] is not None:
        terminal.print_note(f"threshold {estimator.threshold:.4g}")
    return estimator


def _run(
    loaded: ProblemFile, estimator: OnlineEstimator, *, stdin: bool, page: LivePage | None, records: bool
) -> tuple[list[Now], int, bool]:
    """Feed all samples, until Ctrl-C, and print what the estimator says; of a log, those that it has not had yet.

    Return what it said, if that is recorded, how many lines of stdin it refused, and whether it was interrupted.
    """
    from switchfit.cli.sample_lines import read_sample, summarize_now
    from switchfit.online.samples import list_updates

    recorded, refused = [], 0
    (run,) = loaded.problem.experiments
    last = -math.inf if estimator.now is None else estimator.now.time
    with interrupts.stop_on_interrupt(repr, "sample") as report:
        # The callback of `stop_on_interrupt` as a question: has Ctrl-C been pressed?
        stopped = partial(report, None)
        # A log that is replayed from a saved state goes on behind the last sample that the state has seen.
        logged = list_updates([(item.times, item.values) for item in run.data])
        samples: Iterable[Any] = _read_lines(stopped) if stdin else ((t, y, None) for t, y in logged if t > last)
        for number, sample in enumerate(samples, start=1):
            # An empty line, as a terminal or a pipe that is kept alive sends it.
            if stdin and not sample.strip():
                continue
            try:
                # One bad line of a stream must not end an estimate of hours; one of a log is a mistake in a file, and
                # an error.
                t, y, u = read_sample(sample, run) if stdin else sample
                now = estimator.update(t, y, u=u)
            except REFUSED as error:
                if not stdin:
                    raise
                terminal.print_error(f"line {number}: {error}")
                refused += 1
                continue
            # One line for each sample, printed at once: a reader at the other end of a pipe acts on it.
            line = terminal.format_json(summarize_now(now, run))
            if page is not None:
                page.show(line)
            terminal.print_text(line)
            if records:
                recorded.append(now)
            if stopped():
                break
    return recorded, refused, stopped()


def _read_lines(stopped: Callable[[], bool]) -> Iterator[bytes]:
    """Yield the lines of stdin; while it waits for one, Ctrl-C ends it, too."""
    stream = typer.get_binary_stream("stdin")
    while True:
        try:
            # While it waits in readline no callback runs: here Ctrl-C raises, and is passed on as the signal to the
            # handler that counts it.
            with interrupts.handle_interrupt(interrupts.interrupt):
                line = b"" if stopped() else stream.readline()
        except interrupts.CtrlC:
            signal.raise_signal(signal.SIGINT)  # for the handler that makes `stopped` true
            return
        # The end of the stream; an empty line still has its newline.
        if not line:
            return
        yield line


def _serve(loaded: ProblemFile, port: int) -> LivePage:
    from switchfit.cli.live_page import LivePage

    page = LivePage(loaded.path.name, loaded.problem, port)
    terminal.print_note(f"live at {page.address}")
    return page
