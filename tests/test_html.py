"""The report as one HTML file: what it says, and that it needs nothing else."""

import base64
import hashlib
import html.parser
import importlib.metadata
import io
import re
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import matplotlib.image
import numpy as np
import pytest
from models import RAMP
from typer.testing import CliRunner

import switchfit as sf
from switchfit import cli
from switchfit.io.problem_file import load_problem
from switchfit.models import heater_problem
from switchfit.report.plot import find_plane
from switchfit.report.text import tabulate_unknowns
from switchfit.runtime.presentation import format_page
from switchfit.uncertainty.certificate import certify
from switchfit.uncertainty.residuals import correct_errors, correct_intervals

pytestmark = pytest.mark.usefixtures("fits_one_by_one")

pytest.importorskip("jinja2", reason="needs the extra report: pip install 'switchfit[report]'")

EXAMPLES = Path(__file__).parent.parent / "examples"
TOSS = EXAMPLES / "toss" / "problem.toml"
LARGEST = 3_000_000
"""Bytes of a page."""
VOID = {"meta", "link", "input", "br", "img", "hr"}
HOSTILE = '"><script>run()</script>'


class Reader(html.parser.HTMLParser):
    """Reads a page strictly: elements in their order with their attributes, tables as text."""

    def __init__(self, text):
        super().__init__()
        self.open, self.elements, self.tables, self.text = [], [], [], []
        self.feed(text)
        self.close()
        assert not self.open, f"not closed: {self.open}"

    def handle_starttag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))
        if tag not in VOID:
            self.open.append(tag)
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.tables[-1][-1].append("")

    def handle_endtag(self, tag):
        assert self.open
        assert self.open.pop() == tag

    def handle_data(self, text):
        self.text.append(text)
        if {"td", "th"} & set(self.open):
            self.tables[-1][-1][-1] += text

    @property
    def words(self):
        return " ".join(" ".join(self.text).split())

    def count(self, tag):
        return sum(own == tag for own, _ in self.elements)


@pytest.fixture(scope="module")
def toss():
    loaded = load_problem(TOSS)
    return sf.estimate(loaded.problem, **(loaded.options | {"strategy": "local"}))


@pytest.fixture(scope="module")
def toss_page(tmp_path_factory):
    """What the command line writes of the same fit."""
    folder = tmp_path_factory.mktemp("toss")
    done = CliRunner().invoke(cli.app, ["fit", str(TOSS), "--out", str(folder), "--strategy", "local"])
    assert done.exit_code == 0, done.stderr
    return (folder / "report.html").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def heater():
    return sf.estimate(heater_problem())


def hostile_problem():
    """Names of everything that a user names, made to do harm; positions x and y among the names."""
    system = sf.HybridSystem(
        {HOSTILE: lambda t, x, p: p["$$k$$"] * jnp.ones(2), "b": lambda t, x, p: jnp.zeros(2)},
        [0.0, 0.0],
        state_names=(HOSTILE, "@{t}{safe} $$y$$"),
        state_units=("</script>", "m"),
    )
    times = np.linspace(0.1, 4.0, 30)
    noise = 0.05 * np.random.default_rng(1).normal(size=(30, 2))
    values = np.minimum(times, 2.2)[:, None] * [1.0, 1.0] + noise
    data = sf.Measurements(times, values, sigma=0.05)
    runs = [
        sf.Experiment(data, (HOSTILE, "b"), (2.0,), 0.0, 4.0, name=run, time_unit="</script>")
        for run in ("<b>run</b>", "<i>run</i>")
    ]
    return sf.Problem(system, runs, {"$$k$$": sf.Parameter(0.9, unit="<i>")})


def ramps(count):
    """Runs that stop at different times; the last is the noisiest."""
    random = np.random.default_rng(0)
    times = np.linspace(0.1, 4.0, 40)
    runs = []
    for e in range(count):
        values = np.minimum(times, 2.0 + 0.01 * e)[:, None]
        noise = 0.02 * (1 + 4 * (e == count - 1)) * random.normal(size=values.shape)
        data = sf.Measurements(times, values + noise, names=("x",), sigma=0.02)
        runs.append(sf.Experiment(data, ("up", "rest"), (1.8,), 0.0, 4.0))
    return runs


def clock_problem():
    """No data at all: the time at which a position is reached, with a free tf; two positions that are not measured."""
    modes = {"go": lambda t, x, p: p["v"] * jnp.ones(2)}
    system = sf.HybridSystem(modes, [0.0, 0.0], state_names=("x", "y"), state_units=("m", "m"))
    end = sf.TerminalConstraint(lambda x, p: x[0] - 1.0)
    data = [sf.RunningCost(lambda t, x, p: 1.0 + 0.0 * x[0]), end]
    run = sf.Experiment(data, ("go",), (), 0.0, sf.Parameter(1.2, lower=0.2, upper=5.0))
    return sf.Problem(system, run, {"v": sf.Parameter(1.0, fixed=True)})


def fit_and_page(problem):
    """A fit, and its page, made without a warning."""
    fit = sf.estimate(problem, strategy="local")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return fit, format_page(fit)


# --- content ----------------------------------------------------------------------------------------------------------


def test_the_page_says_what_the_text_says_with_the_verdict_first(toss, toss_page):
    reader = Reader(toss_page)
    words, level = reader.words, toss.verdict.level.capitalize()
    assert words.index(level) < words.index("Estimates")
    for part in str(toss.verdict).removesuffix(".").removeprefix(f"{level}: ").split(": ")[-1].split(", or "):
        assert part in words
    for title in ("cost J", "KKT residual", "integration error", "status", "method"):
        line = next(line for line in toss.report(full=True).splitlines() if line.strip().startswith(title))
        assert " ".join(line.split()) in words
    assert all(" ".join(line.split()) in words for line in str(certify(toss, None)).splitlines())
    table = next(t for t in reader.tables if t[0][1] == "value")
    rows, note = tabulate_unknowns(toss, range(len(toss.theta)), ends=True)
    assert table == [[row[k] for k in rows.columns] for row in [rows.titles, *rows.rows]]
    assert note in words
    (correlations,) = (t for t in reader.tables if t[0][1:] == list(toss.theta_names))
    assert [[float(cell) for cell in row[1:]] for row in correlations[1:]] == toss.correlation.round(2).tolist()
    low, high = table[0].index("95 % from"), table[0].index("to")
    ends = [[float(row[low]), float(row[high])] for row in table[1:]]
    assert (np.abs(ends - correct_intervals(toss)) < 0.04 * correct_errors(toss)[:, None]).all()


def list_pictures(text):
    """The pictures of a page."""
    images = [attributes["src"].partition(",") for tag, attributes in Reader(text).elements if tag == "img"]
    assert {kind for kind, _, _ in images} == {"data:image/svg+xml;base64"}
    return [base64.b64decode(content).decode() for _, _, content in images]


def test_the_pictures_are_those_of_the_fit(toss_page):
    said = ("95 % confidence", "transition", "Autocorrelation", "optimality (KKT residual)")
    for picture, part in zip(list_pictures(toss_page), said, strict=True):
        assert f">{part}" in picture, part


def test_the_inputs_are_there_to_run_it_again(toss_page):
    reader = check_alone(toss_page)
    version = f"switchfit {importlib.metadata.version('switchfit')}"
    for part in (" ".join(TOSS.read_text().split()), version, "strategy local", "switchfit fit problem.toml"):
        assert part in reader.words
    (files,) = (t for t in reader.tables if t[0][-1] == "SHA-256")
    raw = (TOSS.parent / "toss_000.csv").read_bytes()
    assert files[1:] == [["toss_000.csv", f"{len(raw):,}", hashlib.sha256(raw).hexdigest()]]


@pytest.mark.usefixtures("quick_certificates")
def test_without_a_problem_file_the_data_are_hashed_and_without_a_model_there_are_no_bands(heater, tmp_path):
    log = heater.problem.experiments[0].data[0]
    raw = np.column_stack([log.times, log.values]).astype("<f8").tobytes()
    assert hashlib.sha256(raw).hexdigest() in Reader(format_page(heater)).words
    with pytest.raises(TypeError, match="provenance must be the provenance of a problem file"):
        heater.save_report(tmp_path / "report.html", provenance="problem.toml")
    heater.save(tmp_path / "fit.json")
    assert "loaded without its model" in Reader(format_page(sf.Estimate.load(tmp_path / "fit.json"))).words


def test_intervals_are_widened_as_the_errors_are_and_on_a_logarithmic_scale_there(toss, heater):
    np.testing.assert_array_equal(correct_intervals(heater), heater.confidence_intervals())
    mu = sf.Parameter(0.3, lower=0.01, upper=2.0, unit="1", scale="log")
    scaled = replace(toss.problem, parameters={**toss.problem.parameters, "mu": mu})
    fit = sf.estimate(scaled, strategy="local")
    factors = correct_errors(fit) / fit.standard_errors
    narrow, wide = fit.confidence_intervals(), correct_intervals(fit)
    assert (factors > 2).all()
    for i, name in enumerate(fit.theta_names):
        scale = np.log if name == "mu" else np.asarray
        free = (wide[i] > fit.lower[i]) & (wide[i] < fit.upper[i])
        near, far = (scale(ends[i][free]) - scale(fit.theta[i]) for ends in (narrow, wide))
        np.testing.assert_allclose(far, factors[i] * near, rtol=1e-9)


def test_positions_in_a_plane_are_told_by_names_and_units():
    for names, units, plane in (
        (("x", "y"), ("m", "m"), (0, 1)),
        (("X", "dX", "Y"), ("m", "m/s", "m"), (0, 2)),
        (("pos_x", "pos_y"), ("", ""), (0, 1)),
        (("north", "east"), ("km", "km"), (1, 0)),
        (("x", "y"), ("m", "V"), None),
        (("v_x", "v_y"), ("", ""), None),
        (("x", "y"), ("m/s", "m/s"), None),
        (("a", "b"), ("m", "m"), None),
    ):
        assert find_plane(names, units) == plane, names
    # Without samples of both there is nothing to draw in it.
    page = fit_and_page(clock_problem())[1]
    check_alone(page)
    assert len(list_pictures(page)) == 1, "the states over time"


# --- one file ---------------------------------------------------------------------------------------------------------


def check_alone(text):
    """Well-formed, small, and without anything that a browser would fetch."""
    assert len(text.encode()) < LARGEST
    reader = Reader(text)
    assert text.startswith("<!DOCTYPE html>\n")
    assert reader.count("script") == 0
    for tag, attributes in reader.elements:
        for name in ("src", "href", "action", "data", "poster", "srcset"):
            value = attributes.get(name, "#")
            assert value.startswith(("#", "data:")), (tag, name, value)
    ids = [attributes["id"] for _, attributes in reader.elements if "id" in attributes]
    assert len(ids) == len(set(ids))
    style = re.search(r"<style>(.*?)</style>", text, re.DOTALL)[1]
    assert "@import" not in style
    assert "url(" not in style
    assert {attributes.get("for") for tag, attributes in reader.elements if tag == "label"} <= {None, *ids}
    return reader


def test_names_do_no_harm():
    fit, text = fit_and_page(hostile_problem())
    reader = check_alone(text)
    assert not any("<script" in picture for picture in list_pictures(text))
    shown = Reader(fit.problem._repr_html_())
    assert shown.count("script") == 0
    assert HOSTILE in reader.words
    assert HOSTILE in shown.words
    assert "Profile of $$k$$" in Reader(fit.profile("$$k$$")._repr_html_()).words


def test_many_runs_stay_small_and_the_worst_come_first():
    fit = sf.estimate(sf.Problem(RAMP, ramps(45), {"v": 0.9}), strategy="local")
    text = format_page(fit)
    reader = check_alone(text)
    assert "Shown are the 10 of 45 runs that are explained worst" in reader.words
    (table,) = (table for table in reader.tables if table[0][1] == "value")
    assert [row[0] for row in table[1:]] == list(fit.theta_names)
    shown = Reader(fit._repr_html_())
    assert (shown.count("img"), shown.text) == (0, [str(fit)])
    assert "and 25 more" in Reader(fit.problem._repr_html_()).words


def test_without_the_extra_it_says_how_to_get_it(heater, tmp_path, monkeypatch):
    monkeypatch.delitem(sys.modules, "switchfit.report.html.page")
    monkeypatch.setitem(sys.modules, "jinja2", None)
    with pytest.raises(ImportError, match=r"needs jinja2, not installed here: pip install 'switchfit\[report\]'"):
        heater.save_report(tmp_path / "report.html")
    done = CliRunner().invoke(cli.app, ["fit", str(TOSS), "--out", str(tmp_path)])
    assert done.exit_code == 0
    assert "no report.html: an HTML report needs jinja2" in done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["estimate.json", "fit.png", "report.txt"]


# --- in a notebook ----------------------------------------------------------------------------------------------------


def test_a_notebook_shows_the_text_and_a_figure(toss):
    shown = toss._repr_html_()
    reader = Reader(shown)
    assert [tag for tag, _ in reader.elements] == ["div", "pre", "img"]
    assert reader.text == [str(toss)]
    kind, _, content = reader.elements[-1][1]["src"].partition(",")
    assert kind == "data:image/png;base64"
    assert matplotlib.image.imread(io.BytesIO(base64.b64decode(content)), format="png")[..., :3].std() > 0.02
    assert len(shown) < 150_000
    assert toss.predict([0.1])._repr_html_().count("<img ") == 1
    lines = [line.split() for line in Reader(heater_problem()._repr_html_()).text[0].splitlines()]
    assert ["run1", "on", "->", "off", "0", "to", "6", "h", "24"] in lines
    assert ["k", "0.5", "0.01", "5", "1/h"] in lines
