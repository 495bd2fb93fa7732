"""The report as one HTML file: what it says, that it needs nothing else, and what it does in a browser."""

import base64
import gzip
import hashlib
import importlib.metadata
import io
import json
import re
import sys
from dataclasses import replace
from functools import cache

import jax.numpy as jnp
import matplotlib.image
import numpy as np
import pytest
from bs4 import BeautifulSoup

import switchfit as sf
from support.commands import run
from support.models import RAMP
from support.places import EXAMPLES
from switchfit.io.problem_file.loading import load_problem
from switchfit.models import heater_problem
from switchfit.report.html.curves import collect_curves, list_places
from switchfit.report.html.sliders import VISIBLE, build_sliders, evaluate_moved, find_range
from switchfit.report.plane import find_plane
from switchfit.report.unknowns import tabulate_unknowns
from switchfit.runtime.presentation import format_page
from switchfit.uncertainty.certificate import certify
from switchfit.uncertainty.corrected_errors import correct_errors, correct_intervals

pytestmark = pytest.mark.usefixtures("fits_one_by_one")

pytest.importorskip("bokeh", reason="needs the extra report: pip install 'switchfit[report]'")
pages = importlib.import_module("switchfit.report.html.page")

TOSS = EXAMPLES / "toss" / "problem.toml"
LARGEST = 5_000_000
"""Bytes of a page."""

HOSTILE = '<script>window.hacked = true</script>"><img src=x onerror="window.hacked = true">'


class Reader:
    """A page: its elements in their order, its words, and its tables as text."""

    def __init__(self, text):
        page = BeautifulSoup(text, "html.parser")
        self.elements = page.find_all(True)
        self.tags = [element.name for element in self.elements]
        self.text = page.get_text()
        self.words = " ".join(page.get_text(" ").split())
        rows = ([row.find_all(["td", "th"]) for row in table.find_all("tr")] for table in page.find_all("table"))
        self.tables = [[[cell.get_text() for cell in row] for row in table] for table in rows]


def payload_of(text):
    return json.loads(re.search(r'<script type="application/json" id="payload">(.*?)</script>', text, re.DOTALL)[1])


def array_of(source, column):
    """A column of a source, from what Bokeh makes of it."""
    entry = dict(source["entries"])[column]
    return np.frombuffer(gzip.decompress(base64.b64decode(entry["array"]["data"])), dtype=entry["dtype"]).astype(float)


@pytest.fixture(scope="module")
def toss():
    loaded = load_problem(TOSS)
    return sf.estimate(loaded.problem, **(loaded.options | {"strategy": "local"}))


@pytest.fixture(scope="module")
def toss_page(tmp_path_factory):
    """What the command line writes of the same fit."""
    folder = tmp_path_factory.mktemp("toss")
    run("fit", TOSS, "--out", folder, "--strategy", "local", code=0)
    return (folder / "report.html").read_text(encoding="utf-8")


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
    data = sf.Measurements(times, np.minimum(times, 2.2)[:, None] + noise, sigma=0.05)
    run = sf.Experiment(data, (HOSTILE, "b"), (2.0,), 0.0, 4.0, time_unit="</script>")
    runs = [replace(run, name=name) for name in ("<b>run</b>", "<i>run</i>")]
    return sf.Problem(system, runs, {"$$k$$": sf.Parameter(0.9, unit="<i>")})


def ramps(count=1):
    """Runs that stop at different times; the last is the noisiest."""
    random = np.random.default_rng(0)
    times = np.linspace(0.1, 4.0, 40)
    runs = []
    for e in range(count):
        values = np.minimum(times, 2.0 + 0.01 * e) + 0.02 * (1 + 4 * (e == count - 1)) * random.normal(size=40)
        data = sf.Measurements(times, values, names=("x",), sigma=0.02)
        runs.append(sf.Experiment(data, ("up", "rest"), (1.8,), 0.0, 4.0))
    return runs


def late_problem():
    """An estimated delay, a robust loss with an outlier, a missing sample."""
    times = np.linspace(0.2, 4.2, 41)
    values = np.clip(times - 0.2, 0.0, 2.0) + 0.01 * np.sin(37 * times)
    values[[5, 20]] = np.nan, values[20] + 1.0
    data = sf.Measurements(times, values, names=("x",), sigma=0.01, delay="late", loss="huber")
    unknowns = {"v": 0.9, "late": sf.Parameter(0.1, lower=0.0, upper=0.2, unit="s")}
    return sf.Problem(RAMP, sf.Experiment(data, ("up", "rest"), (1.8,), 0.0, 4.2), unknowns)


def clock_problem():
    """No data at all: the time at which a position is reached, with a free tf; two positions that are not measured."""
    modes = {"go": lambda t, x, p: p["v"] * jnp.ones(2)}
    system = sf.HybridSystem(modes, [0.0, 0.0], state_names=("x", "y"), state_units=("m", "m"))
    data = [sf.RunningCost(lambda t, x, p: 1.0 + 0.0 * x[0]), sf.TerminalConstraint(lambda x, p: x[0] - 1.0)]
    run = sf.Experiment(data, ("go",), (), 0.0, sf.Parameter(1.2, lower=0.2, upper=5.0))
    return sf.Problem(system, run, {"v": sf.Parameter(1.0, fixed=True)})


KINDS = {"hostile names": hostile_problem, "delay, outliers": late_problem, "no data": clock_problem}


@cache
def fit_and_page(kind):
    """A fit of a kind of problem, and its page."""
    fit = sf.estimate(KINDS[kind](), strategy="local")
    return fit, format_page(fit)


# --- content ----------------------------------------------------------------------------------------------------------


def test_the_page_says_what_the_text_says_with_the_verdict_first(toss, toss_page):
    reader = Reader(toss_page)
    words, level = reader.words, toss.verdict.level.capitalize()
    assert words.index(level) < words.index("Estimates")
    assert str(toss.verdict).removesuffix(".").rpartition(", or ")[2] in words
    lines = toss.report(full=True).splitlines() + str(certify(toss, None)).splitlines()
    for title in ("cost J", "KKT residual", "integration error", "status", "method"):
        line = next(line for line in lines if line.strip().startswith(title))
        assert " ".join(line.split()) in words
    table = next(t for t in reader.tables if t[0][1] == "value")
    rows, note = tabulate_unknowns(toss, range(len(toss.theta)), ends=True)
    assert table == [[row[k] for k in rows.columns] for row in [rows.titles, *rows.rows]]
    assert note in words
    (correlations,) = (t for t in reader.tables if t[0][1:] == list(toss.theta_names))
    assert [[float(cell) for cell in row[1:]] for row in correlations[1:]] == toss.correlation.round(2).tolist()
    low, high = table[0].index("95 % from"), table[0].index("to")
    ends = [[float(row[low]), float(row[high])] for row in table[1:]]
    assert (np.abs(ends - correct_intervals(toss)) < 0.04 * correct_errors(toss)[:, None]).all()


def test_curves_and_samples_in_the_page_are_those_of_the_fit(toss, toss_page):
    payload = payload_of(toss_page)
    assert "match_aspect" in json.dumps(payload["templates"]["run-0"]), "the path in the plane"
    (run,) = payload["runs"]
    comparison, samples, curve = toss.comparisons[0][0], run["sources"]["samples-0"], run["sources"]["curve-0"]
    np.testing.assert_array_equal(array_of(samples, "m0"), comparison.measured[:, 0])
    np.testing.assert_allclose(array_of(samples, "y1"), comparison.residuals[:, 1], atol=1e-15)
    times, y = array_of(curve, "t"), array_of(curve, "y0")
    there = ~np.isnan(times)
    np.testing.assert_allclose(y[there], np.interp(times[there], comparison.curve_times, comparison.curve[:, 0]))
    assert np.isnan(times).sum() == np.isnan(y).sum() == 1, "broken at the transition"
    first, last = toss.trajectory.times[[0, -1]]
    margins = first - run["ranges"]["times"]["start"], run["ranges"]["times"]["end"] - last
    assert margins[0] == pytest.approx(margins[1])
    assert 0.0 < margins[0] < 0.1 * (last - first)


def test_the_inputs_are_there_to_run_it_again(toss_page):
    reader = check_alone(toss_page)
    version = f"switchfit {importlib.metadata.version('switchfit')}"
    for part in (" ".join(TOSS.read_text().split()), version, "strategy local", "switchfit fit problem.toml"):
        assert part in reader.words
    (files,) = (t for t in reader.tables if t[0][-1] == "SHA-256")
    raw = (TOSS.parent / "toss_000.csv").read_bytes()
    assert files[1:] == [["toss_000.csv", f"{len(raw):,}", hashlib.sha256(raw).hexdigest()]]


@pytest.mark.usefixtures("quick_certificates")
def test_without_a_model_nothing_moves(heater, tmp_path):
    heater.save(tmp_path / "fit.json")
    text = format_page(sf.Estimate.load(tmp_path / "fit.json"))
    assert payload_of(text)["sliders"] == []
    assert "loaded without its model" in Reader(text).words


def test_intervals_are_widened_as_the_errors_are_and_on_a_logarithmic_scale_there(toss, heater):
    np.testing.assert_array_equal(correct_intervals(heater), heater.confidence_intervals())
    mu = sf.Parameter(0.3, lower=0.01, upper=2.0, unit="1", scale="log")
    fit = sf.estimate(replace(toss.problem, parameters={**toss.problem.parameters, "mu": mu}), strategy="local")
    factors = correct_errors(fit) / fit.standard_errors
    narrow, wide = fit.confidence_intervals(), correct_intervals(fit)
    assert (factors > 2).all()
    for i, name in enumerate(fit.theta_names):
        scale = np.log if name == "mu" else np.asarray
        free = (wide[i] > fit.lower[i]) & (wide[i] < fit.upper[i])
        near, far = (scale(ends[i][free]) - scale(fit.theta[i]) for ends in (narrow, wide))
        np.testing.assert_allclose(far, factors[i] * near, rtol=1e-9)


# --- sliders ----------------------------------------------------------------------------------------------------------


def test_costs_along_an_unknown_are_exact(toss, toss_page):
    payload = payload_of(toss_page)
    assert {slider["name"] for slider in payload["sliders"]} == set(toss.theta_names)
    for slider in payload["sliders"]:
        assert slider["values"][0] < slider["theta"] < slider["values"][-1]
        for k in (0, 7, -1):
            theta = toss.theta.copy()
            theta[slider["place"]] = slider["values"][k]
            assert slider["costs"][k] == pytest.approx(toss.evaluator_at_solution().cost(theta), rel=1e-9)


def test_costs_of_joint_fits_count_all_runs_and_the_priors():
    known = sf.Parameter(0.9, prior=sf.Normal(1.0, 0.01))
    fit = sf.estimate(sf.Problem(RAMP, ramps(3), {"v": known}))
    for place, moved in enumerate(fit.theta + 0.01 * np.eye(len(fit.theta))):
        expected = fit.evaluator_at_solution().cost(moved)
        assert evaluate_moved(fit, place, moved[place]) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("name", ["mu", "vx0"])
def test_curves_follow_an_unknown_to_first_order(toss, name):
    """Off by the square of the step, and a residual by as much the other way."""
    place, step = toss.theta_names.index(name), 1e-2
    (own, *_) = collect_curves(toss, 0, [place], 800)
    curve, log = own.curve, own.samples
    path = sf.simulate(toss.problem, toss.theta + step * (np.arange(len(toss.theta)) == place))
    there = ~np.isnan(curve["t"])
    exact, samples = (np.interp(t, path.times, path.states[:, 0]) for t in (curve["t"][there], log["t"]))
    assert np.abs(exact - (curve["y0"] + step * curve[f"d{place}_0"])[there]).max() < 0.02 * step
    assert np.abs(samples - (log["m0"] - log["y0"]) + step * log[f"d{place}_0"]).max() < 0.02 * step
    assert np.abs(log[f"d{place}_0"]).max() > 0.01


def test_a_delay_has_no_slider_and_the_page_says_how_late_its_samples_are():
    fit, text = fit_and_page("delay, outliers")
    assert {slider["name"] for slider in payload_of(text)["sliders"]} == set(fit.theta_names) - {"late"}
    assert f"x is late by {fit.parameters['late']:.6g} s" in Reader(text).words


def test_sliders_stop_at_bounds_and_at_what_can_be_seen(toss):
    runs = {0: collect_curves(toss, 0, list_places(toss, 0), 200)}
    sliders = build_sliders(toss, runs, list_places(toss, 0))
    assert sliders[0]["values"][-1] < toss.trajectory.times[-1]
    tight = replace(toss, lower=toss.theta - 1e-6, upper=toss.theta + 1e-6)
    assert find_range(tight, runs, 1) == (tight.lower[1], tight.upper[1])
    for slider in sliders:
        reach, place = slider["values"][-1] - slider["theta"], slider["place"]
        curves = [(own.curve[f"d{place}_{k}"], own.curve[f"y{k}"]) for own in runs[0] for k in range(len(own.names))]
        moved = [reach * np.nanmax(np.abs(slope)) / (np.nanmax(y) - np.nanmin(y)) for slope, y in curves]
        assert max(moved) <= VISIBLE * (1 + 1e-6)


@pytest.mark.parametrize(
    ("names", "units", "plane"),
    [
        (("X", "dX", "Y"), ("m", "m/s", "m"), (0, 2)),
        (("pos_x", "pos_y"), ("", ""), (0, 1)),
        (("north", "east"), ("km", "km"), (1, 0)),
        (("x", "y"), ("m", "V"), None),
        (("v_x", "v_y"), ("", ""), None),
        (("x", "y"), ("m/s", "m/s"), None),
        (("a", "b"), ("m", "m"), None),
    ],
)
def test_positions_in_a_plane_are_told_by_names_and_units(names, units, plane):
    assert find_plane(names, units) == plane


# --- one file ---------------------------------------------------------------------------------------------------------


def check_alone(text):
    """Small, each name once, and without anything that a browser would fetch."""
    assert len(text.encode()) < LARGEST
    reader = Reader(text)
    assert text.startswith("<!DOCTYPE html>\n")
    for element in reader.elements:
        for name in {"src", "href", "action", "data", "poster", "srcset"} & element.attrs.keys():
            assert element[name].startswith(("#", "data:")), element.attrs
    ids = [element["id"] for element in reader.elements if "id" in element.attrs]
    assert len(ids) == len(set(ids))
    assert not re.search(r"@import|url\(", re.search(r"<style>(.*?)</style>", text, re.DOTALL)[1])
    return reader


def test_names_do_no_harm():
    fit, text = fit_and_page("hostile names")
    reader, shown = check_alone(text), Reader(fit.problem._repr_html_())
    assert (reader.tags.count("script"), shown.tags.count("script")) == (3, 0)
    assert reader.tags.count("img") == 2
    assert HOSTILE in reader.words
    assert HOSTILE in shown.words
    assert "Profile of $$k$$" in Reader(fit.profile("$$k$$")._repr_html_()).words


def test_many_runs_stay_small_and_the_worst_come_first():
    fit = sf.estimate(sf.Problem(RAMP, ramps(45), {"v": 0.9}), strategy="local")
    text = format_page(fit)
    reader, payload = check_alone(text), payload_of(text)
    assert len(payload["runs"]) == pages.MOST_RUNS_IN_PAGE
    assert f"The {pages.MOST_RUNS_IN_PAGE} of 45 runs that are explained worst" in reader.words
    assert re.findall(r'<option value="\d+">\s*(\S+):', text)[0] == fit.run_names[-1]
    assert len([name for name in payload["templates"] if name.startswith("run-")]) == 1, "all runs share a drawing"
    assert len(text) < 2_500_000
    shown = Reader(fit._repr_html_())
    assert (shown.tags.count("img"), shown.text) == (0, str(fit))
    assert "and 42 more experiments" in Reader(fit.problem._repr_html_()).words


def test_without_the_extra_it_says_how_to_get_it(heater, tmp_path, monkeypatch):
    monkeypatch.delitem(sys.modules, "switchfit.report.html.page")
    monkeypatch.setitem(sys.modules, "bokeh", None)
    with pytest.raises(ImportError, match=r"needs bokeh, which cannot be .*: pip install 'switchfit\[report\]'"):
        heater.save_report(tmp_path / "report.html")
    said = run("fit", TOSS, "--out", tmp_path, code=0).stderr
    assert "no report.html: an HTML report needs bokeh" in said
    assert sorted(path.name for path in tmp_path.iterdir()) == ["estimate.json", "fit.png", "report.txt"]


# --- in a notebook ----------------------------------------------------------------------------------------------------


def test_a_notebook_shows_the_text_and_a_figure(toss):
    shown = toss._repr_html_()
    reader = Reader(shown)
    assert (reader.tags, reader.text) == (["div", "pre", "img"], str(toss))
    kind, _, content = reader.elements[-1]["src"].partition(",")
    assert kind == "data:image/png;base64"
    assert matplotlib.image.imread(io.BytesIO(base64.b64decode(content)), format="png")[..., :3].std() > 0.02
    assert len(shown) < 150_000
    lines = [line.split() for line in Reader(heater_problem()._repr_html_()).text.splitlines()]
    assert ["on", "->", "off", "on", "[0,", "6]", "h,", "at", "2", "h"] in lines
    assert ["k", "0.5", "1/h", "in", "[0.01,", "5]"] in lines


# --- in a browser -----------------------------------------------------------------------------------------------------


def check_quiet(browser):
    """No error, no warning, nothing asked of the network."""
    assert browser.errors == []
    assert [url for url in browser.requests if not url.startswith(("file:", "data:", "blob:"))] == []


def write(folder, text):
    path = folder / "report.html"
    path.write_text(text, encoding="utf-8")
    return path


COLUMN = """(source, column) => {
  const found = Bokeh.documents.map((doc) => doc.get_model_by_name(source)).find(Boolean);
  return Array.from(found.data[column]).map((v) => (Number.isNaN(v) ? null : v));
}"""

SET = """(name, value, event) => {
  const element = document.getElementById(name);
  element.value = value;
  element.dispatchEvent(new Event(event));
}"""


def test_sliders_move_curves_modes_and_cost(browser, toss, toss_page, tmp_path):
    browser.open(write(tmp_path, toss_page))
    sliders = {slider["name"]: (k, slider) for k, slider in enumerate(payload_of(toss_page)["sliders"])}

    def read(source, column):
        return np.array(browser.evaluate(f"({COLUMN})('{source}', '{column}')"), float)

    def cost():
        return browser.evaluate("document.getElementById('cost').textContent")

    before = {source: read(source, "y0") for source in ("curve-0", "samples-0")}
    assert cost() == f"J = {toss.cost:.7e} (at the estimate)".replace("e-0", "e-")
    k, slider = sliders["mu"]
    browser.evaluate(f"({SET})('slider-{k}', 400, 'input')")
    change, slope = slider["values"][-1] - slider["theta"], f"d{slider['place']}_0"
    for source, old in before.items():
        np.testing.assert_allclose(read(source, "y0"), old + change * read(source, slope), rtol=1e-9, atol=1e-15)
    assert float(cost().split()[2].rstrip(",")) == pytest.approx(slider["costs"][-1], rel=1e-6)
    assert "(evaluated)" in cost()

    k, slider = sliders["tau_1"]
    browser.evaluate(f"({SET})('slider-{k}', 0, 'input')")
    assert "(by the quadratic approximation)" in cost()
    moved = read("transitions", "x")[0], read("modes", "right")[0], read("modes", "left")[1]
    assert moved == pytest.approx((slider["values"][0],) * 3)

    browser.evaluate("document.getElementById('reset').click()")
    np.testing.assert_array_equal(read("curve-0", "y0"), before["curve-0"])
    assert "(at the estimate)" in cost()
    check_quiet(browser)


@pytest.mark.slow
def test_runs_are_chosen_channels_switched_off_and_all_of_it_printed(browser, tmp_path):
    browser.open(write(tmp_path, format_page(sf.estimate(sf.Problem(RAMP, ramps(4), {"v": 0.9})))))
    shown = "[...document.querySelectorAll('#fit .run.shown')].map((r) => r.dataset.run).join()"
    names = "[...document.querySelectorAll('.slider.shown label')].map((l) => l.textContent).join()"
    height = "document.getElementById('run-0').getBoundingClientRect().height"
    assert (browser.evaluate(shown), browser.evaluate(names)) == ("0", "run4.tau_1,v")
    for value, runs in (("2", "2"), ("all", "0,1,2,3")):
        browser.evaluate(f"({SET})('run', '{value}', 'change')")
        browser.wait("[...document.querySelectorAll('#fit .run.shown .figure')].every((f) => f.offsetHeight > 300)")
        assert browser.evaluate(shown) == runs
    before = browser.evaluate(height)
    browser.evaluate("document.querySelector('[data-channel=\"0-0\"]').click()")
    browser.wait(f"{height} < {before - 200}", 10)
    browser.evaluate("document.querySelectorAll('details').forEach((d) => { d.open = false; })")
    assert browser.print().startswith(b"%PDF")
    assert browser.evaluate("[...document.querySelectorAll('details')].every((d) => d.open)")
    check_quiet(browser)


@pytest.mark.parametrize(
    "kind", ["hostile names", *(pytest.param(kind, marks=pytest.mark.slow) for kind in list(KINDS)[1:])]
)
def test_every_kind_of_problem_is_shown_without_an_error(browser, tmp_path, kind):
    _, text = fit_and_page(kind)
    check_alone(text)
    browser.open(write(tmp_path, text))
    for k in range(len(payload_of(text)["sliders"])):
        browser.evaluate(f"({SET})('slider-{k}', 300, 'input')")
    browser.evaluate("document.querySelectorAll('[data-channel]').forEach((box) => { if (!box.checked) box.click(); })")
    browser.evaluate("new Promise((done) => setTimeout(done, 200))")
    assert browser.evaluate("window.hacked") is None
    check_quiet(browser)
