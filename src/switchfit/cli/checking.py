"""``switchfit init`` and ``examples``, to begin with; ``check``, ``simulate`` and ``design``, a problem without a fit;
``paper``, the paper's experiments.
"""

from __future__ import annotations

import ast
import os
import shlex
import shutil
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

import switchfit as sf
from switchfit.cli import terminal
from switchfit.cli.terminal import argument, option, output_folder
from switchfit.io import find_examples, refuse_existing
from switchfit.runtime.files import write_atomically

NewFolder = Annotated[str, argument("NAME", "Folder to create.")]
FirstLog = Annotated[
    Path | None, option("--from", metavar="LOG", help="Log to begin with, of any format. Default: an example.")
]


@terminal.command("quiet")
def init(name: NewFolder, log: FirstLog = None) -> None:
    """Create a problem to begin with, ready to fit.

    Writes a folder with a problem file, its model and data. With --from the time column and up to three channels of
    the log are chosen, with a first model that suits any log: each channel approaches a level, another one from an
    estimated time on. Comments say what to change. A log of more than 20 MB is not copied. Nothing is overwritten.
    """
    from switchfit.io.problem_file.writing import write_first_problem
    from switchfit.report.text import write_experiments

    folder = Path(name)
    written = write_first_problem(folder, log)
    loaded = terminal.load(folder / "problem.toml")
    terminal.print_text("\n".join(["Written", *(f"  {path}" for path in written), ""]))
    terminal.print_text(write_experiments(loaded.problem.experiments))
    problem, out = shlex.quote(str(folder / "problem.toml")), shlex.quote(str(folder / "out"))
    terminal.print_text(f"\nNext\n  switchfit check {problem}\n  switchfit fit {problem} --out {out}\n")
    terminal.print_text(f"Then put your own modes into {folder / 'model.py'}.")


def _complete_examples(incomplete: str) -> list[str]:
    return [name for name in _list_examples() if name.startswith(incomplete)]


def _list_examples() -> dict[str, Path]:
    """Return the examples by name: folders and single files."""
    found = sorted(find_examples().glob("[!_.]*"))
    return {path.stem: path for path in found if path.is_dir() or path.suffix == ".py"}


ExampleName = Annotated[
    str | None, argument("NAME", "Example to copy. Left out, all are listed.", autocompletion=_complete_examples)
]
ExampleFolder = Annotated[Path | None, argument("FOLDER", "Folder to create. Default: one of the name.")]


@terminal.command()
def examples(name: ExampleName = None, folder: ExampleFolder = None) -> None:
    """List the examples, or copy one.

    It is copied into a new folder. Nothing is overwritten.
    """
    found = _list_examples()
    if name is None:
        width = max(map(len, found), default=0)
        terminal.print_text("\n".join(f"{each:<{width}}  {_describe(path)}" for each, path in found.items()))
        terminal.print_note("\nCopy one with: switchfit examples NAME")
        return
    if name not in found:
        terminal.fail(f"there is no example {name!r}; there are {', '.join(found)}.")
    target = Path(name) if folder is None else folder
    refuse_existing(target, "FOLDER")
    source = found[name]
    if source.is_dir():
        shutil.copytree(source, target, ignore=shutil.ignore_patterns("__pycache__"), dirs_exist_ok=True)
    else:
        target.mkdir(parents=True, exist_ok=True)
        shutil.copy(source, target)
    commands = [f"switchfit {_choose_command(path)} {shlex.quote(str(path))}" for path in sorted(target.glob("*.toml"))]
    commands = commands or [f"python {shlex.quote(str(path))}" for path in sorted(target.glob("*.py"))]
    terminal.print_text("\n".join([f"Copied to {target}. Next", *(f"  {command}" for command in commands)]))


def _choose_command(path: Path) -> str:
    """Return the command for a problem file: a search where the mode sequence is what is looked for."""
    contents = tomllib.loads(path.read_text(encoding="utf-8"))
    is_search = "library" in contents and not any("mode_sequence" in run for run in contents.get("experiments", []))
    return "modes" if is_search else "fit"


def _describe(path: Path) -> str:
    """Return what an example is about: the title of its README, or the first line of its problem file or script."""
    readme = path / "README.md"
    if readme.is_file():
        return readme.read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ")
    script = path if path.is_file() else next(iter(sorted(path.glob("*.py"))), None)
    text = "" if script is None else ast.get_docstring(ast.parse(script.read_text(encoding="utf-8"))) or ""
    return text.partition("\n")[0]


@terminal.command("json", "quiet", "verbose")
def check(
    problem: terminal.ProblemPath,
    no_run: Annotated[
        bool, typer.Option("--no-run", help="Read the problem file and its data; run no Python file that it names.")
    ] = False,
    full: Annotated[
        bool,
        typer.Option("--full", help="List all runs and unknowns, and compare with the paper's equations too: seconds."),
    ] = False,
) -> None:
    """Check a problem without fitting it.

    Shows the data, the unknowns and the steps of the integrator, whether the derivatives are right, and what the data
    determine at the first guess.

    Exit code 0: the derivatives are right. 1: they are not. 2: the input is wrong.
    """
    if no_run:
        _check_files(problem, full)
        return
    loaded = terminal.load(problem)
    from switchfit.fit.evaluator import evaluator_of
    from switchfit.io.command_line import summarize_check
    from switchfit.report.text import write_problem, write_steps
    from switchfit.report.uncertainty import write_orders

    terminal.print_text(f"{write_problem(loaded.problem, full=full)}\n")
    terminal.print_list("Logs", loaded.issues)
    evaluator = evaluator_of(loaded.problem)
    terminal.print_text(f"{write_steps(evaluator, full=full)}\n")
    if terminal.is_asked("verbose"):
        terminal.print_note(evaluator.engine)
    derivatives = sf.check_derivatives(loaded.problem, paper=full)
    short = f"Derivatives of J along a random direction\n  {write_orders(derivatives)}"
    terminal.print_text(f"{derivatives if full else short}\n")
    found = sf.identifiability(loaded.problem)
    terminal.print_text(found)
    terminal.print_json(
        summarize_check(evaluator, derivatives, found) | {"issues": [str(issue) for issue in loaded.issues]}
    )
    terminal.fail_for_refused(loaded.issues)
    if not derivatives.passed:
        raise typer.Exit(terminal.NOT_CONVERGED)


def _check_files(problem: Path, full: bool) -> None:
    """Print the parts of a problem that are known without running a Python file."""
    from switchfit.io.problem_file import read_experiments

    runs = read_experiments(problem)
    from switchfit.report.text import write_experiments

    if runs.experiments:
        terminal.print_text(f"{write_experiments(runs.experiments, full=full)}\n")
        terminal.print_list("Logs", runs.issues)
    terminal.print_text("No Python file was run: modes, states, functions and names of parameters are not checked.")
    names = [run.name for run in runs.experiments]
    terminal.print_json({"runs": names, "issues": [str(issue) for issue in runs.issues]})
    terminal.fail_for_refused(runs.issues)


OutputFile = Annotated[Path, option("--out", metavar="FILE.csv", help="CSV file to write.")]
Times = Annotated[
    str,
    option(metavar="STEP", help="A step, such as 0.1, or 'samples': times of the data. Default: the integrator's."),
]


@terminal.command("quiet")
def simulate(problem: terminal.ProblemPath, out: OutputFile, times: Times = "") -> None:
    """Integrate the model at the first guess.

    Writes times, modes and states as CSV. The column of times is named t, or for example "t (min)" if the
    experiments' time_unit is "min" instead of "s". Where times are dates, a column "date" has them, in the time zone of
    the experiment.
    """
    loaded = terminal.load(problem)
    from switchfit.io.command_line import choose_times, write_trajectories

    given = [choose_times(times, experiment) for experiment in loaded.problem.experiments]
    runs = [sf.simulate(loaded.problem, experiment=e, times=when) for e, when in enumerate(given)]
    table = write_trajectories(loaded.problem.run_names, runs)
    terminal.make_folder(out.parent)
    write_atomically(table, out)


DesignFolder = Annotated[
    Path | None, output_folder("design.txt, design.json, design.png, and the designed input and sample times as CSV")
]
Criterion = Annotated[
    Literal["D", "A", "E"] | None,
    option(help="What is made small of the covariance: D, the determinant; A, the trace; E, the largest eigenvalue."),
]
Samples = Annotated[int | None, option(metavar="COUNT", help="Most samples of each sensor. Default: all of the file.")]


@terminal.command("json", "quiet", "verbose")
def design(
    problem: terminal.ProblemPath,
    out: DesignFolder = None,
    criterion: Criterion = None,
    samples: Samples = None,
    figures: terminal.FigureFormat = "png",
) -> None:
    """Find the experiment that will determine unknowns best.

    Chooses inputs within limits, sample times and sensors of the last run of the file, at the first guess of the
    unknowns, and prints the standard errors to expect. [design] of the problem file says what is free; options override
    it. The values of the run's data are not used: a log with the possible times and zeros will do.

    Exit code 0: all unknowns that count can be estimated with the design. 1: some cannot. 2: the input is wrong.
    """
    loaded = terminal.load(problem, out)
    from switchfit.io.command_line import summarize_design

    terminal.print_list("Logs", [issue for issue in loaded.issues if issue.kind != "log: constant"])
    table = loaded.contents.design
    settings = {} if table is None else table.model_dump(exclude_none=True)
    settings |= terminal.select_given(criterion=criterion, samples=samples)
    plan = sf.design(loaded.problem, **settings)
    terminal.show(plan, summarize_design(plan), out, "design", figures, saved=True)
    if out is not None:
        _write_plan(plan, out)
    terminal.fail_for_refused(loaded.issues)
    if lost := [name for name in plan.names if name in plan.undetermined]:
        terminal.end_unreliable(f"{', '.join(lost)} cannot be estimated from such an experiment.")


def _write_plan(plan: Any, folder: Path) -> None:
    """Write the input and the samples of a design as CSV."""
    from switchfit.io.command_line import write_rows, zip_rows

    knots = plan.problem.experiments[plan.experiment].inputs
    if knots is not None:
        write_atomically(write_rows(zip_rows({"t": knots.times, **plan.inputs})), folder / "input.csv")
    samples = [{"sensor": name, "t": time} for name, times in plan.sample_times.items() for time in times]
    write_atomically(write_rows(samples, ("sensor", "t")), folder / "samples.csv")


PaperFolder = Annotated[Path, typer.Option(metavar="DIR", help="Folder for figures, results.json and table.md.")]
Quick = Annotated[bool, typer.Option("--quick", help="Fewer repetitions: two minutes instead of fifteen.")]
Part = Annotated[
    str | None, option(metavar="NAME", help="One part: lti, magic-formula, convergence, noise, trials or horizon.")
]


@terminal.command()
def paper(out: PaperFolder = Path("paper"), quick: Quick = False, only: Part = None) -> None:
    """Reproduce the paper's experiments and figures.

    Every experiment and figure of Miller and Murphey, with its numbers beside ours. An interrupted run resumes when
    the same command is run again.
    """
    os.environ.setdefault("MPLBACKEND", "Agg")
    from switchfit.paper import TABLE, run

    terminal.make_folder(out)
    try:
        run(out, quick=quick, only=only, say=terminal.print_note)
    except KeyboardInterrupt:
        terminal.fail("interrupted; run the same command again to resume.", terminal.INTERRUPTED)
    terminal.print_text((out / TABLE).read_text(encoding="utf-8"))
    terminal.print_note(f"written to {out}")
