"""The help texts of the commands, written into a page when the documentation is built."""

from __future__ import annotations

from pathlib import Path

import typer
from typer.testing import CliRunner

from switchfit import cli

WIDTH = 100


def write(folder: Path) -> None:
    """Write commands.md: a heading and the help text of each command."""
    commands = sorted(typer.main.get_command(cli.app).commands)
    sections = [f"## switchfit {name}\n\n```text\n{read_help(name)}```\n" for name in commands]
    folder.mkdir(exist_ok=True)
    (folder / "commands.md").write_text("\n".join(sections), encoding="utf-8")


def read_help(command: str) -> str:
    """Return what ``switchfit COMMAND --help`` prints, without the blanks at the ends of its lines."""
    settings = {"prog_name": "switchfit", "terminal_width": WIDTH, "max_content_width": WIDTH, "color": False}
    shown = CliRunner().invoke(cli.app, [command, "--help"], **settings)
    if shown.exit_code != 0:
        raise RuntimeError(f"switchfit {command} --help failed: {shown.output}")
    return "".join(line.rstrip() + "\n" for line in shown.output.strip().splitlines())
