"""Malformed problem files, tables, model files and command lines: a sentence and an exit code, never a traceback."""

from __future__ import annotations

import random
import re
import traceback
import warnings
from collections import Counter
from pathlib import Path

import jax
import pytest
from typer.testing import CliRunner

import switchfit as sf
from support.problem_folder import fill_folder
from switchfit import cli
from switchfit.engine.native.program_cache import drop_programs
from switchfit.io.problem_file import tables
from switchfit.paper import runner


@pytest.fixture
def files(tmp_path):
    return fill_folder(tmp_path)


SIZES = [pytest.param(40, id="short"), pytest.param(1200, id="long", marks=pytest.mark.fuzz)]


ODD = (
    "true", "0", "1", "-1", "2", "3", "1" + "0" * 30, "1" + "0" * 5000, "0.0", "-0.0", "0.5", "3.0", "1e308", "1e-320",
    "-1e308", "nan", "inf", "-inf", '""', '"a"', '"T"', '"t"', '"on"', '"nowhere"', '"room.py:room"', '"room.py:make"',
    '"room.py:seven"', '"room.py:nothing"', '":"', '".py:"', '"nothing.py:room"', '"a.py:b.py:c"', '"../room.py:room"',
    '"log.csv"', '"/dev/zero"', '"/"', '"a\\u0000b"', f'"{"x" * 5000}"', '"é🙂"', '"skid_steer"', '"cubic"', '"huber"',
    '"log"', "[]", "[[]]", "[0.0]", "[1.0, 2.0]", '["on"]', '["on", "off"]', '["on", "off", "on"]', '[1, "a"]', "{}",
    "[[1.0], [2.0]]", "{ a = 1 }", "{ value = 1.0 }", "{ value = 1.0, lower = 2.0 }", "{ value = 1.0, fixed = true }",
    "{ value = 1.0, prior = { mean = 1.0 } }", "{ value = 1.0, prior = { mean = 1.0, sd = -1.0 } }",
    '{ value = -1.0, scale = "log" }', '{ name = "room.py:make" }', '{ name = "room.py:make", arguments = { a = 1 } }',
    '{ file = "log.csv", time = "t", columns = ["u"] }', '{ file = "log.csv", time = "t", columns = ["T", "u"] }',
)  # fmt: skip
"""Values of keys, as TOML."""

KEYS = re.findall(r"\w+", Path(tables.__file__).read_text())
"""All words of the module with the keys."""


def change_values(text: str, rng: random.Random) -> bytes:
    """Drop, add, rename, retype or nest entries of a problem file."""
    lines = text.splitlines()
    for _ in range(rng.choice([1, 1, 1, 2, 4])):
        k = rng.choice([k for k, line in enumerate(lines) if " = " in line])
        key, _, value = lines[k].partition(" = ")
        changes = [
            "",
            f"{lines[k]}\n{rng.choice(KEYS)} = {rng.choice(ODD)}",
            f"{rng.choice(KEYS)} = {value}",
            f"{key} = {rng.choice(ODD)}",
            f"{key} = {rng.choice(ODD)}",
            f"{key} = [{value}]",
            f"{key} = {{ value = {value} }}",
        ]
        lines[k] = rng.choice(changes)
    return "\n".join(lines).encode("utf-8", "replace")


def change_text(text: str, pieces: tuple[str, ...], rng: random.Random) -> bytes:
    """Cut, repeat, insert or replace somewhere; sometimes in bytes, so that it is no text any more."""
    for _ in range(rng.choice([1, 1, 2, 5])):
        a, b = sorted((rng.randrange(len(text) + 1), rng.randrange(len(text) + 1)))
        b = min(b, a + rng.choice([1, 3, 40]))
        changed = [text[:a] + text[b:], text[:a] + text[a:b] * 2 + text[b:], text[:a] + rng.choice(pieces) + text[b:]]
        text = rng.choice(changed)
    data = text.encode(rng.choice(["utf-8"] * 8 + ["utf-16", "utf-8-sig"]), "replace")
    if rng.random() < 0.1:
        data = data[: len(data) // 2] + bytes([rng.randrange(256)]) + data[len(data) // 2 :]
    return data


PIECES = {
    "problem.toml": (
        *"[]{}='\"\n\0\r#,.\\\ufeff", '"""', "1e999", "nan", "-inf", "[" * 3000, "1_0", "0x1F", "1979-05-27",
        "[[experiments]]\n", "[options]\n", "[experiments]\n", "true", "{}", "[]",
    ),
    "log.csv": (
        *",;\t\n\r\"#\0 -é\ufeff\u2028\x0b", "\r\n", '""', "nan", "inf", "-inf", "1e999", "1e308", "1_0", "0x10", "NA",
        "abc", "--5", "1,5", "x" * 200_000, "99999999999999999999", "2024-01-01", "5,5,5,5\n", "-3,1,1,1\n",
        "3,1,1,1\n", "t,T,sd,u\n", '"a\nb"',
    ),
    "room.py": (
        *"xpt():\n\t\0", "raise KeyboardInterrupt\n", "raise SystemExit\n", "1 / 0\n", "import nothing\n", "    ",
        "None", "x[5]", "jnp.zeros(3)", "'a'", "p['new']", "x.astype('float32')", "jnp.nan", "float(x[0])", "1e308",
        "jnp.exp(1e5)", "lambda: 0", "{}", "[]", "return", "yield 1", "raise GeneratorExit", "sf.nothing", "sf",
        "raise type('Odd', (BaseException,), {})", "print(x)", "0j", "x > 0", "if x[0] > 0: return x",
    ),
}  # fmt: skip
"""What is put into a file of each kind."""


def outcome(*arguments: str) -> str:
    """What became of a command: its exit code, or what is wrong with the way it ended."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of numbers near the limits of float64, and those of the model's own text
        result = CliRunner().invoke(cli.app, list(arguments))
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        return "".join(traceback.format_exception(result.exception))
    if result.exit_code not in (0, 1, 2) or "Traceback" in result.stderr:
        return f"exit code {result.exit_code}\n{result.stderr}"
    if result.exit_code and not result.stderr.strip():
        return f"exit code {result.exit_code} without a word"
    return str(result.exit_code)


@pytest.fixture
def folder(files, monkeypatch):
    monkeypatch.chdir(files)
    return files


COMMANDS = (
    ("check", "problem.toml", "--no-run"),
    ("check", "problem.toml", "--no-run"),
    ("simulate", "problem.toml", "--out", "x.csv"),
    ("fit", "problem.toml", "--max-iterations", "1"),
)


@pytest.mark.parametrize("count", SIZES)
@pytest.mark.parametrize(
    ("name", "change", "least"),
    [
        ("problem.toml", change_values, 0.6),
        ("problem.toml", change_text, 0.5),
        ("log.csv", change_text, 0.4),
        ("room.py", change_text, 0.3),
    ],
    ids=["other values", "other text", "tables", "models"],
)
def test_damaged_files(count, name, change, least, folder):
    """At least this part of them has to be refused."""
    found: Counter[str] = Counter()
    whole = (folder / name).read_text()
    count = count // 3 if name == "room.py" else count
    for number in range(count):
        rng = random.Random(f"{name} {number}")
        pieces = () if change is change_values else (PIECES[name],)
        (folder / name).write_bytes(change(whole, *pieces, rng))
        said = outcome(*rng.choice(COMMANDS[2:] if name == "room.py" else COMMANDS))
        assert said in "012", f"number {number}: {said}"
        found[said] += 1
        if number % 200 == 199:  # a process may map so many pieces of memory
            jax.clear_caches()
            drop_programs()
    assert found["2"] >= least * count, found


@pytest.mark.parametrize("command", ["fit", "check", "simulate", "paper"])
@pytest.mark.parametrize(
    "words",
    [
        *(["nowhere.toml"], ["."], ["/dev/zero"], ["problem.toml/x"], [""], ["a\0b"], ["\udcff"], ["x" * 5000]),
        *(["problem.toml", *more] for more in (["--out"], ["--out", "log.csv/out"], ["--nothing"], ["-x"], ["é"])),
        *(["problem.toml", "--max-iterations", number] for number in ("-1", "2.5", "nan", "1e400", str(10**30))),
        *(["problem.toml", "--hessian", "newton"], ["--only", "nothing"], ["--", "-"]),
    ],
    ids=lambda words: ascii(" ".join(words))[:40],
)
def test_command_lines(command, words, folder, monkeypatch):
    def enough(*arguments, **options):
        raise ValueError("enough")

    for module, name in ((sf, "estimate"), (sf, "check_derivatives"), (sf, "simulate"), (runner, "run")):
        monkeypatch.setattr(module, name, enough)
    assert outcome(command, *words) == "2"
