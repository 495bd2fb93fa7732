"""``switchfit init`` and ``switchfit examples``: problems to begin with."""

from __future__ import annotations

import ast
import shutil
from pathlib import Path
from typing import Annotated

from switchfit.cli import terminal
from switchfit.cli.terminal import argument, option
from switchfit.io import find_examples

NewFolder = Annotated[str, argument("NAME", "Folder to create.")]
FirstLog = Annotated[
    Path | None, option("--from", metavar="LOG", help="Log to begin with, of any format. Default: an example.")
]


def init(
    name: NewFolder,
    log: FirstLog = None,
    quiet: terminal.Quiet = False,
    debug: terminal.Debug = False,
) -> None:
    """Create a problem to begin with, ready to fit.

    Writes a folder with a problem file, its model and data. With --from the time column and up to three channels of
    the log are chosen, with a first model that suits any log: each channel approaches a level, another one from an
    estimated time on. Comments say what to change. A log of more than 20 MB is not copied. Nothing is overwritten.
    """
    with terminal.report_errors(debug, quiet=quiet):
        from switchfit.io.command_line import describe_experiments
        from switchfit.io.first_problem import write_first_problem
        from switchfit.io.problem_file import load_problem

        folder = Path(name)
        written = write_first_problem(folder, log)
        loaded = load_problem(folder / "problem.toml")
        terminal.print_text("\n".join(["Written", *(f"  {path}" for path in written), ""]))
        terminal.print_text(describe_experiments(loaded.problem.experiments))
        terminal.print_text(
            f"\nNext\n  switchfit check {folder / 'problem.toml'}\n  switchfit fit {folder / 'problem.toml'} --out "
            f"{folder / 'out'}\n\nThen put your own modes into {folder / 'model.py'}."
        )


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


def examples(
    name: ExampleName = None,
    folder: ExampleFolder = None,
    debug: terminal.Debug = False,
) -> None:
    """List the examples, or copy one.

    It is copied into a new folder. Nothing is overwritten.
    """
    with terminal.report_errors(debug):
        found = _list_examples()
        if name is None:
            width = max(map(len, found), default=0)
            terminal.print_text("\n".join(f"{each:<{width}}  {_describe(path)}" for each, path in found.items()))
            terminal.print_note("\nCopy one with: switchfit examples NAME")
            return
        if name not in found:
            terminal.fail(f"there is no example {name!r}; there are {', '.join(found)}.")
        target = Path(name) if folder is None else folder
        if target.exists() and (not target.is_dir() or any(target.iterdir())):
            terminal.fail(f"{target} exists already, and nothing is overwritten: give another FOLDER.")
        source = found[name]
        if source.is_dir():
            shutil.copytree(source, target, ignore=shutil.ignore_patterns("__pycache__"), dirs_exist_ok=True)
        else:
            target.mkdir(parents=True, exist_ok=True)
            shutil.copy(source, target)
        problems, scripts = sorted(target.glob("*.toml")), sorted(target.glob("*.py"))
        commands = [f"switchfit {_choose_command(path)} {path}" for path in problems]
        commands = commands or [f"python {path}" for path in scripts]
        terminal.print_text("\n".join([f"Copied to {target}. Next", *(f"  {command}" for command in commands)]))


def _choose_command(path: Path) -> str:
    """Return the command for a problem file: a search where the mode sequence is what is looked for."""
    import tomllib

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
