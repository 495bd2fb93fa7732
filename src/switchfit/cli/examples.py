"""``switchfit examples``: list the examples, or copy one."""

from __future__ import annotations

import ast
import shlex
import shutil
import tomllib
from pathlib import Path
from typing import Annotated

from switchfit.cli import command as command_module
from switchfit.cli import errors, terminal
from switchfit.cli.files import refuse_existing
from switchfit.cli.options import argument

ExampleFolder = Annotated[Path | None, argument("FOLDER", "Folder to create. Default: one of the name.")]
PACKAGE = Path(__file__).parents[1]


def _complete_examples(incomplete: str) -> list[str]:
    return [name for name in _list_examples() if name.startswith(incomplete)]


def _list_examples() -> dict[str, Path]:
    """Return the examples by name: folders and single files."""
    # Names with an underscore are parts of others, such as the first problem of `switchfit init`.
    found = sorted(find_examples().glob("[!_.]*"))
    return {path.stem: path for path in found if path.is_dir() or path.suffix == ".py"}


ExampleName = Annotated[
    str | None, argument("NAME", "Example to copy. Left out, all are listed.", autocompletion=_complete_examples)
]


@command_module.command()
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
        errors.fail(f"there is no example {name!r}; there are {', '.join(found)}.")
    target = Path(name) if folder is None else folder
    # Before anything is written.
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
    # A library beside given sequences is only for `switchfit online`.
    is_search = "library" in contents and not any("mode_sequence" in run for run in contents.get("experiments", []))
    return "modes" if is_search else "fit"


def _describe(path: Path) -> str:
    """Return what an example is about: the title of its README, or the first line of its problem file or script."""
    readme = path / "README.md"
    if readme.is_file():
        return readme.read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ")
    # An example without a README says what it is about in the first line of its script.
    script = path if path.is_file() else next(iter(sorted(path.glob("*.py"))), None)
    text = "" if script is None else ast.get_docstring(ast.parse(script.read_text(encoding="utf-8"))) or ""
    return text.partition("\n")[0]


def find_examples() -> Path:
    """Return the folder of the examples: inside the installed package, or that of a clone."""
    inside = PACKAGE / "examples"
    return inside if inside.is_dir() else PACKAGE.parents[1] / "examples"
