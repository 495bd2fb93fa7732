"""docs/first-ten-minutes.md, run: its commands print what the page shows, up to times and last digits."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
from typer.testing import CliRunner

from support.places import ROOT
from switchfit import cli

PAGE = ROOT / "docs" / "first-ten-minutes.md"

NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
VARYING = re.compile(r"effort|optimality|integration error|tried")
"""Lines with numbers that differ between machines: times, what is left by rounding."""
CLOSE = 0.02
"""Largest relative difference of the other numbers: a unit of the second digit that is printed, or a little more."""


def read_steps(text):
    """Return the steps of the page in order: ("file", name, content) or ("command", line, printed)."""
    steps = []
    for match in re.finditer(r"^```(\w+)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
        kind, block = match.groups()
        if kind in ("python", "toml"):
            name = re.search(r"Save this as `([\w./]+)`:\s*$", text[: match.start()])[1]
            steps.append(("file", name, block))
        elif kind == "console":
            commands = re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]
            steps += [("command", *command.split("\n", 1)) for command in commands]
    return steps


def follows(printed, shown):
    """Whether lines that were printed are those of the page, in which ``...`` stands for any lines."""
    if not shown:
        return not printed
    if shown[0] == "...":
        return any(follows(printed[k:], shown[1:]) for k in range(len(printed) + 1))
    return bool(printed) and agree(printed[0], shown[0]) and follows(printed[1:], shown[1:])


def agree(printed, shown):
    """Whether two lines are the same but for last digits, widths of columns, and numbers that differ elsewhere."""
    if NUMBER.sub("#", printed).split() != NUMBER.sub("#", shown).split():
        return False
    ours, theirs = (np.array(NUMBER.findall(line), float) for line in (printed, shown))
    return bool(VARYING.search(shown)) or np.allclose(ours, theirs, rtol=CLOSE, atol=0)


def run(command):
    """Run a line of the shell; return what it prints.

    After the first one, commands of switchfit run in this process; test_commands.py has one in a process of its own.
    """
    name, *arguments = shlex.split(command)
    if name == "switchfit" and arguments != ["--version"]:
        return CliRunner(env={"COLUMNS": "100"}).invoke(cli.app, arguments).output
    done = subprocess.run(["sh", "-c", command], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    return done.stdout


def test_the_commands_print_what_the_page_shows(tmp_path, monkeypatch):
    shutil.copytree(ROOT / "examples", tmp_path / "examples", ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setenv("PATH", str(Path(sys.executable).parent), prepend=os.pathsep)
    monkeypatch.setenv("PYTHONPATH", str(ROOT / "src"), prepend=os.pathsep)
    monkeypatch.setenv("LC_ALL", "C.UTF-8")
    monkeypatch.chdir(tmp_path)
    commands = 0
    for kind, line, text in read_steps(PAGE.read_text(encoding="utf-8")):
        if kind == "file":
            Path(line).write_text(text, encoding="utf-8")
        elif line.startswith("cd "):
            monkeypatch.chdir(shlex.split(line)[1])
        else:
            printed = run(line)
            assert follows(printed.splitlines(), text.splitlines()), f"$ {line}\n{printed}\nThe page has:\n{text}"
            commands += 1
    assert commands > 8
    assert "<html" in (tmp_path / "room" / "out" / "report.html").read_text(encoding="utf-8")


def test_the_log_is_what_its_script_writes(tmp_path):
    script = ROOT / "examples" / "room" / "make_log.py"
    (tmp_path / script.name).write_text(script.read_text())
    subprocess.run([sys.executable, tmp_path / script.name], check=True)
    assert (tmp_path / "room.csv").read_bytes() == script.with_name("room.csv").read_bytes()
