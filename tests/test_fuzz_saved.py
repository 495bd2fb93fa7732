"""Damaged estimates: each is refused with the name of its file."""

from __future__ import annotations

import copy
import json
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_report import made, several
from test_save import CERTIFICATE, assert_same, with_everything_odd, without_numbers

import switchfit as sf
from switchfit.estimation.saved import load_saved, save_fit, write_fit
from switchfit.fit.result import Fit, Kink
from switchfit.problem.unknowns import ActiveConstraint

SIZES = [pytest.param(50, id="short"), pytest.param(12_000, id="long", marks=pytest.mark.fuzz)]
ODD: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 2, 3, 10**30, -(10**400), 0.0, -0.0, 0.5, 1e308, 1e-320, "NaN", "Infinity", "", "a",
    "tau_1", "exact", "\ud800", "\0", "$", [], [[]], [0.0], [1.0, 2.0], [[1.0], [2.0, 3.0]], ["nan"] * 3, {}, {"a": 1},
    {"dtype": "<f8", "shape": [0], "values": []}, {"dtype": "<f4", "shape": [1], "values": [1.0]},
    {"dtype": "<U99999999999", "shape": [1], "values": ["a"]}, {"dtype": "|b1", "shape": [2, 1], "values": [True, 0]},
    {"dtype": "<i8", "shape": [2], "values": [0, 9]}, {"dtype": "<U1", "shape": [], "values": ["a"]},
)  # fmt: skip
"""What may stand where something else should."""

KEPT = ("format", "version", "seal", "fit", "certificate")
"""What has to be as it was written; a reader of the file may note something beside it."""


def saved() -> list[dict[str, Any]]:
    """Contents of files of several kinds of fits."""
    constrained = made(
        constraints=(("x_1 at the end", 1e-9, 2.0),), priors={"mu": "normal(1, 2)"}, log_scaled=("mu",),
        kinks=(Kink("tau_1", 4.0, -1.0, 1.0),), active=(ActiveConstraint("lower bound", 0.05, "mu"),),
        saved_gauss_newton=np.eye(3) * 300.0,
    )  # fmt: skip
    fits = [made(), made(sigma_known=False), several(3), without_numbers(), with_everything_odd(), constrained]
    return [_content(fit) for fit in fits]


def _content(fit: Fit) -> dict[str, Any]:
    return json.loads(json.dumps(write_fit(fit, CERTIFICATE)))


def places(value: Any, here: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Paths of everything inside a JSON value."""
    inside = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [here] * bool(here) + [path for key, entry in inside for path in places(entry, (*here, key))]


def mutate(content: Any, rng: random.Random) -> None:
    """One change at a place drawn by its depth first, so that large arrays do not take all of them."""
    found = places(content)
    depth = rng.choice(sorted({len(path) for path in found}))
    path = rng.choice([path for path in found if len(path) == depth])
    holder = content
    for key in path[:-1]:
        holder = holder[key]
    key, value = path[-1], holder[path[-1]]
    kind = rng.choice(["drop", "twice", "odd", "odd", "other", "resize", "nest", "flip"])
    if kind == "drop":
        del holder[key]
    elif kind == "twice":
        if isinstance(holder, list):
            holder.insert(key, copy.deepcopy(value))
        else:
            holder[f"{key}_2"] = copy.deepcopy(value)
    elif kind == "odd":
        holder[key] = copy.deepcopy(rng.choice(ODD))
    elif kind == "other":
        other = content
        for step in rng.choice(found):
            other = other[step]
        holder[key] = copy.deepcopy(other)
    elif kind == "resize" and isinstance(value, list):
        cut = rng.randrange(len(value) + 1)
        holder[key] = rng.choice([value[:cut], value + value[:cut], value[::-1]])
    elif kind == "nest":
        holder[key] = rng.choice([[value], {"a": value}, [value, copy.deepcopy(value)]])
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        holder[key] = rng.choice([-value, value * 1e300, value / 1e300, value + 1, float(value)])
    elif isinstance(value, str):
        holder[key] = rng.choice([value[::-1], value * 2, value.upper()])


def is_refused(path: Path, number: int) -> bool:
    """Whether a file is refused; AssertionError if that is not by a ValueError that names it."""
    try:
        sf.Estimate.load(path)
    except Exception as error:
        if not isinstance(error, ValueError) or not str(error).startswith(f"{path} is "):
            raise AssertionError(f"damage {number}") from error
        return True
    return False


@pytest.mark.parametrize("count", SIZES)
def test_what_was_changed_is_refused(count, tmp_path):
    originals = saved()
    path = tmp_path / "fit.json"
    for number in range(count):
        rng = random.Random(number)
        original = originals[number % len(originals)]
        content = copy.deepcopy(original)
        for _ in range(rng.choice([1, 1, 1, 2, 5])):
            mutate(content, rng)
        path.write_text(json.dumps(content))
        parts = [[json.dumps(each.get(name), sort_keys=True) for name in KEPT] for each in (content, original)]
        assert is_refused(path, number) == (parts[0] != parts[1]), f"mutation {number}"


@pytest.mark.parametrize("count", SIZES)
def test_a_file_with_damaged_bytes_is_refused_or_the_same(count, tmp_path):
    """Cut off, bits that flipped, pieces that were written twice or moved."""
    save_fit(made(), CERTIFICATE, tmp_path / "whole.json")
    whole, path = (tmp_path / "whole.json").read_bytes(), tmp_path / "fit.json"
    for number in range(count):
        rng = random.Random(number)
        data = bytearray(whole)
        a, b = sorted(rng.sample(range(len(data)), 2))
        kind = rng.choice(["cut", "flip", "repeat", "remove", "zeros"])
        if kind == "cut":
            del data[b:]
        elif kind == "flip":
            data[a] ^= 1 << rng.randrange(8)
        elif kind == "repeat":
            data[b:b] = data[a : min(b, a + 50)]
        elif kind == "remove":
            del data[a : min(b, a + 50)]
        else:
            data[a:b] = bytes(b - a)
        path.write_bytes(data)
        if not is_refused(path, number):
            assert_same(made(), load_saved(path).fit)
