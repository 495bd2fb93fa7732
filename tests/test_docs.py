"""The blocks of code in README.md and on the pages, run as they stand: a page's blocks in order, in an empty folder."""

import re
import shlex
import shutil
from pathlib import Path

import jax
import matplotlib
import pytest
from typer.testing import CliRunner

from switchfit import cli
from switchfit.io.problem_file import load_problem

matplotlib.use("agg")

ROOT = Path(__file__).parent.parent
PAGES = sorted(
    [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *ROOT.glob("docs/*.md"), *ROOT.glob("examples/*/README.md")]
)

#: Pages that start processes.
HEAVY = {"many-fits.md"}

RUN = ("python", "sh", "console", "toml")
NOT_CODE = ("text", "{image}", "{figure}", "{include}", "{toctree}", "")
"""Kinds of blocks that are run, and those that are not: what was printed, pictures, diagrams."""


def blocks_of(page):
    """(kind, text) of each fenced block."""
    return re.findall(r"^```(\S*)[^\n]*\n(.*?)^```$", page.read_text(), re.MULTILINE | re.DOTALL)


def pages_with(*kinds):
    return [
        pytest.param(page, id=page.relative_to(ROOT).as_posix(), marks=[pytest.mark.slow] * (page.name in HEAVY))
        for page in PAGES
        if any(kind in kinds for kind, _ in blocks_of(page))
    ]


def commands_of(page):
    """Command lines of a page, without prompts and comments."""
    text = "".join(block for kind, block in blocks_of(page) if kind in ("sh", "console"))
    lines = [line.removeprefix("$ ") for line in text.splitlines()]
    return [command for line in lines if (command := shlex.split(line, comments=True))]


@pytest.fixture
def clone(tmp_path, monkeypatch):
    """A folder that has the examples, as a clone has, to work in."""
    shutil.copytree(ROOT / "examples", tmp_path / "examples", ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.chdir(tmp_path)
    before = jax.config.read("jax_enable_x64")  # a page on samplers turns it on
    yield tmp_path
    jax.config.update("jax_enable_x64", before)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_every_block_says_what_it_is(page):
    """A block that is indented, or of an unknown kind, would not be run."""
    assert {kind for kind, _ in blocks_of(page)} <= {*RUN, *NOT_CODE}
    prose = re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    assert not re.search(r"\n\n    \S", prose), "an indented block: fence it, and say which language it is"


@pytest.mark.parametrize("page", pages_with("python"))
def test_python_runs(page, clone):
    names = {"__name__": "__main__"}
    for k, (kind, block) in enumerate(blocks_of(page), start=1):
        if kind == "python":
            exec(compile(block, f"{page.name}, block {k}", "exec"), names)


@pytest.mark.parametrize(
    "page", [p for p in pages_with("sh", "console") if any(c[0] == "switchfit" for c in commands_of(p.values[0]))]
)
def test_commands_of_ours_run(page, clone):
    for command, *arguments in commands_of(page):
        if command == "switchfit":
            done = CliRunner().invoke(cli.app, arguments)
            assert done.exit_code == 0, f"{arguments}: {done.output}"


@pytest.mark.parametrize("page", pages_with("toml"))
def test_problem_files_can_be_read(page, clone):
    for k, (kind, block) in enumerate(blocks_of(page), start=1):
        if kind == "toml":
            file = clone / "examples" / "toss" / f"block_{k}.toml"
            file.write_text(block)
            assert load_problem(file).problem.theta_names
