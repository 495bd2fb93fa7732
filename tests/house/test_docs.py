"""The blocks of code in README.md and on the pages, run as they stand: a page's blocks in order, in an empty folder."""

import ast
import re
import runpy
import shlex
import subprocess
import sys
from functools import cache
from importlib import import_module
from operator import attrgetter

import matplotlib
import pytest
from typer.testing import CliRunner

import switchfit as sf
from support.functions import FALLS_BACK
from support.pages import blocks_of, copy_examples
from support.places import ROOT
from switchfit import cli
from switchfit.engine.native.tracing import entries, matrices, sorting, trace
from switchfit.io.problem_file.loading import load_problem


@pytest.fixture
def clone(tmp_path, monkeypatch):
    """A folder that has the examples, as a clone has, to work in."""
    copy_examples(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


matplotlib.use("agg")
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("examples/*/README.md")])

#: Pages that take a second or more.
HEAVY = (
    "figures report command-line how-many-switches uncertainty validation terrain many-runs guards design "
    "online convergence what-now vehicles real-logs dates fishing husky sharp"
)

#: Blocks that are files and commands of one session; tests/house/test_tutorial.py runs them in order.
SESSIONS = {"first-ten-minutes.md"}

RUN = ("python", "sh", "console", "toml")
NOT_CODE = ("text", "{image}", "{figure}", "{glossary}", "{include}", "{toctree}", "")
"""Kinds of blocks that are run, and those that are not: what was printed, pictures, diagrams."""


def pages_with(*kinds):
    pages = [page for page in PAGES if page.name not in SESSIONS and {kind for kind, _ in blocks_of(page)} & {*kinds}]
    slow = [[pytest.mark.slow] * (page.stem in HEAVY.split()) for page in pages]
    return [
        pytest.param(page, id=str(page.relative_to(ROOT)), marks=mark) for page, mark in zip(pages, slow, strict=True)
    ]


def commands_of(page):
    """Command lines of a page, without prompts, comments, and what commands print."""
    blocks = [(kind, block) for kind, block in blocks_of(page) if kind in ("sh", "console")]
    lines = [(kind, line) for kind, block in blocks for line in block.splitlines()]
    lines = [line.removeprefix("$ ") for kind, line in lines if kind == "sh" or line.startswith("$ ")]
    return [command for line in lines if (command := shlex.split(line, comments=True))]


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
            assert load_problem(file, searched=True).problem.theta_names


@cache
def read_texts():
    """Return every text in the library, with a mark where an f-string puts a value; neighbouring literals are one."""
    texts = []
    for path in (ROOT / "src").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.JoinedStr):
                texts.append("".join(part.value if isinstance(part, ast.Constant) else "…" for part in node.values))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                texts.append(node.value)
    return "\n".join(texts)


@pytest.mark.parametrize("name", ["sharp.md", "what-now.md"])
def test_messages_that_are_quoted_exist(name):
    """In the first column of a table, what stands in quotation marks is a part of a message of the library."""
    rows = re.findall(r"^\| (.+?) \|", (ROOT / "docs" / name).read_text(), re.MULTILINE)
    quoted = [part for row in rows for message in re.findall(r'"([^"]+)"', row) for part in message.split("...")]
    parts = [part.strip() for part in quoted if part.strip()]
    assert len(parts) > 3
    assert not [part for part in parts if part not in read_texts()]


# What has machine code, and what JAX has to do


def rows_of(section):
    """Rows of the table of a section: lists of cells."""
    text = (ROOT / "docs" / "engines.md").read_text().split(f"## {section}\n")[1].split("\n## ")[0]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"][2:]


def test_the_page_names_what_jax_has_to_do():
    left = {name for _, examples in rows_of("JAX") for name in re.findall(r"`([^`]*)`", examples)}
    reasons = [reason for reason in FALLS_BACK.values() if "(limit" not in reason]
    called = {found[1] for reason in reasons if (found := re.match(r"calls ([\w.]+\w)", reason))}
    assert len(called) > 10
    assert not called - left


def test_the_page_claims_machine_code_only_for_what_has_it():
    written = {name for _, examples, _ in rows_of("Machine code") for name in re.findall(r"`([^`]*)`", examples)}
    fallen = {name for name in written for why in FALLS_BACK.values() if f"calls {name}" in why and "(limit" not in why}
    assert len(written) > 30
    assert not fallen


@pytest.mark.parametrize(
    ("row", "limits"),
    [
        ("branches, loops", (trace.MOST_NODES,)),
        ("tables of numbers", (entries.MOST_ROWS_OF_TABLE,)),
        ("tables of parameters", (entries.MOST_CHOICES,)),
        ("indices that depend", (entries.MOST_CHOICES,)),
        ("linear systems", (matrices.MOST_ROWS_TO_PIVOT,)),
        ("Cholesky", (matrices.MOST_ROWS, matrices.MOST_KNOWN_ROWS)),
        ("sorting", (sorting.MOST_SORTED,)),
    ],
)
def test_the_limits_on_the_page_are_those_of_the_code(row, limits):
    (cell,) = (limit for what, _, limit in rows_of("Machine code") if what.startswith(row))
    assert tuple(map(int, re.findall(r"\d+", cell))) == limits


# What is written, and how much of it


def test_every_public_name_is_in_the_reference():
    listed = set(re.findall(r"^   (\w+)$", (ROOT / "docs" / "api.rst").read_text(), re.MULTILINE))
    assert set(sf.__all__) <= listed, "add them to docs/api.rst, each to its topic"


def test_the_documentation_is_short():
    """Pages without the tables that benchmarks write (docs/measured); the path of a newcomer; two screens of README."""
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *ROOT.glob("docs/*.md")]
    readme = (ROOT / "README.md").read_text().splitlines()
    assert sum(len(page.read_text().split()) for page in pages) <= 33_000
    index = (ROOT / "docs" / "index.md").read_text()
    path = re.findall(r"^\d\. \[.+?\]\(([\w-]+)\.md\)", index, re.M)
    assert len(path) <= 8
    assert re.search(rf"^:caption: Start here\n\n{chr(10).join(path)}\n```$", index, re.M)
    assert len(readme) <= 100
    assert max(map(len, readme)) <= 120


@pytest.mark.slow
def test_the_picture_of_the_readme_is_that_of_the_fit():
    """Matplotlib writes each text of a figure as a comment into the SVG: the numbers are those of the fit."""
    script = runpy.run_path(str(ROOT / "docs" / "idea_figures.py"))
    picture = (ROOT / "docs" / "idea.svg").read_text(encoding="utf-8")
    texts = re.findall("<!-- (.+?) -->", picture)
    assert set(script["write_numbers"](script["fit"]())) <= set(texts), "run python docs/idea_figures.py"
    assert len(picture) < 200_000


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The folder of the pages; any warning is an error."""
    pytest.importorskip("sphinx")
    pytest.importorskip("furo")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", ROOT / "docs", folder]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    return folder


@pytest.mark.slow
def test_no_page_loads_anything_from_a_network(site):
    """Scripts, images and styles; links to click do not count."""
    pages = list(site.rglob("*.html"))
    assert len(pages) > 60
    for page in pages:
        tags = re.findall(r"<(?:script|img|iframe|source|link)\b[^>]*>", page.read_text(encoding="utf-8"))
        loaded = [tag for tag in tags if "rel=" not in tag or re.search(r'rel="[^"]*(stylesheet|icon|preload)', tag)]
        sources = [re.search(r'\b(?:src|href)="([^"]*)"', tag) for tag in loaded]
        assert not [source[1] for source in sources if source and "//" in source[1]], page.name


def test_what_the_reference_names_is_there():
    module = None
    for line in (ROOT / "docs" / "api.rst").read_text().splitlines():
        if line.startswith(".. currentmodule:: "):
            module = import_module(line.split()[-1])
        elif re.fullmatch(r"   [A-Za-z_][\w.]*", line):
            assert attrgetter(line.strip())(module) is not None
