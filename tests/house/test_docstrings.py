"""Docstrings of what is public: each has examples that run, and says what to look at next."""

import doctest
import inspect
import re
from enum import EnumType

import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest

import switchfit as sf
from switchfit import models
from switchfit.io.problem_file.loading import load_problem

matplotlib.use("agg")


NAMESPACE = {"sf": sf, "np": np, "jnp": jnp, "heater_problem": models.heater_problem}
"""What every example may use without an import; `docs/api.rst` says so."""


def public():
    """Functions, classes and their public methods by name, each method under the class that defines it."""
    found = {f"models.{name}": getattr(models, name) for name in models.__all__ if callable(getattr(models, name))}
    found["load_problem"] = load_problem
    for name in sf.__all__:
        item = getattr(sf, name)
        found[name] = item
        for base in item.__mro__ if inspect.isclass(item) else ():
            for method, raw in vars(base).items():
                function = getattr(raw, "__func__", raw)
                if not method.startswith("_") and inspect.isfunction(function):
                    found[f"{base.__name__}.{method}"] = function
    return {name: item for name, item in found.items() if item.__module__.startswith("switchfit.")}


PUBLIC = public()


def section(item, title):
    """Lines of a section of a numpydoc docstring."""
    text = inspect.getdoc(item) or ""
    match = re.search(rf"^{title}\n-+\n(.*?)(?=\n\n[A-Z][A-Za-z ]+\n-{{3,}}\n|\Z)", text, re.MULTILINE | re.DOTALL)
    return match[1] if match else ""


def exists(name):
    """Whether a name in See Also leads to something, from the package or from its root."""
    item = sf
    for part in name.removeprefix("switchfit.").split("."):
        if part in {field for base in getattr(item, "__mro__", ()) for field in getattr(base, "__annotations__", {})}:
            return True
        if not hasattr(item, part):
            return False
        item = getattr(item, part)
    return True


@pytest.mark.parametrize("name", PUBLIC)
def test_there_are_examples_and_references_and_what_is_described_is_there(name):
    """Of models and readers every parameter is described; of the others, `test_repo.py` finds what is missing."""
    item = PUBLIC[name]
    assert ">>>" in section(item, "Examples"), f"{name} has no Examples section"
    assert section(item, "See Also"), f"{name} has no See Also section"
    sections = f"{section(item, 'Parameters')}\n{section(item, 'Attributes')}"
    lines = re.findall(r"^(\w+(?:, \w+)*)(?: :|$)", sections, re.MULTILINE)
    described = {each for line in lines for each in line.split(", ")}
    if name.startswith("models.") or name == "load_problem":
        assert set(inspect.signature(item).parameters) <= described
    elif name in sf.__all__ and not issubclass(type(item), EnumType):
        assert described
        set_by_itself = re.findall(r"self\.(\w+)", inspect.getsource(item))
        assert described <= {*inspect.signature(item).parameters, *dir(item), *set_by_itself}


@pytest.mark.parametrize("name", [name for name, item in PUBLIC.items() if section(item, "Examples")])
def test_examples_run_and_print_what_they_say(name, optimised_machine_code):
    (examples,) = doctest.DocTestFinder(recurse=False).find(PUBLIC[name], name, globs=dict(NAMESPACE))
    report = []
    result = doctest.DocTestRunner(verbose=False).run(examples, out=report.append)
    assert result.failed == 0, "".join(report)
    assert result.attempted >= 1


@pytest.mark.parametrize("name", [name for name, item in PUBLIC.items() if section(item, "See Also")])
def test_references_lead_somewhere(name):
    for line in section(PUBLIC[name], "See Also").splitlines():
        for reference in line.partition(" : ")[0].split(","):
            assert exists(reference.strip()), f"{name}: See Also names {reference.strip()!r}, which is not there"
            assert reference.strip() != name, f"{name}: See Also names itself"
