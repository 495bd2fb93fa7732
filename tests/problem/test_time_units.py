"""The unit of times: one source, the experiment; everything that prints a time uses it, and nothing converts it."""

import json
import re

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.text import Text

import switchfit as sf
from support.commands import run as invoke
from support.models import refused
from support.problem_folder import PROBLEM, ROOM
from switchfit.io.problem_file.loading import load_problem
from switchfit.report.problem import write_problem
from switchfit.uncertainty import derivative_check

pytestmark = pytest.mark.usefixtures("fits_one_by_one")

MINUTES = np.arange(1.0, 120.0, 4.0)
LONE_S = re.compile(r"(?<![\w'’])s(?!\w)")
"""The letter s by itself, as a unit stands in texts and in JSON; neither s² nor the s of "Newton's"."""


def without_wall_time(text: str) -> str:
    """Seconds of the clock on the wall left out: they are never the same, and seconds whatever the unit of the log."""
    text = re.sub(r"(evaluations?),\s+[\d.e+-]+\s+s\b", r"\1", text)
    text = re.sub(r"(J\s+=\s+[\d.e+-]+)\s+\([\d.e+-]+\s+s\)", r"\1", text)
    return re.sub(r"fits in [\d.]+ s \([\d.]+ ms each\)", "fits", text)


def on(t, x, p):
    return p["heating"] - p["cooling"] * (x - 15.0)


def off(t, x, p):
    return -p["cooling"] * (x - 15.0)


def room(**more):
    return sf.HybridSystem({"on": on, "off": off}, [15.0], state_names=("T",), state_units=("°C",), **more)


def log(switched=43.0, seed=1, **more):
    """Heated at 0.5 °C/min until `switched`, noise 0.1 °C."""
    heated = 25.0 * (1.0 - np.exp(-0.02 * np.minimum(MINUTES, switched)))
    exact = 15.0 + heated * np.exp(-0.02 * np.maximum(MINUTES - switched, 0.0))
    noise = 0.1 * np.random.default_rng(seed).standard_normal(len(MINUTES))
    return sf.Measurements(MINUTES, exact + noise, sigma=0.1, names=("T",), **more)


def run(tau=30.0, data=None, modes=("on", "off"), **more):
    taus = tau if isinstance(tau, tuple) else (tau,)
    return sf.Experiment(log() if data is None else data, modes, taus, t0=0.0, tf=120.0, **more)


HEATING, COOLING = sf.Parameter(0.3, 0.01, 2.0, unit="°C/min"), sf.Parameter(0.05, 0.001, 1.0, unit="1/min")
RATES = {"heating": HEATING, "cooling": COOLING}


def problem(unit, **more):
    """Two runs: the transition time of the first is estimated, that of the second known."""
    fixed = sf.Parameter(46.0, fixed=True, unit=unit)
    runs = [run(time_unit=unit), run(fixed, log(46.0, 2), time_unit=unit, name="known")]
    return sf.Problem(room(), runs, RATES, **more)


def doubtful(unit):
    """Twelve readings, from which the transition time and the rates cannot well be told apart."""
    few = sf.Measurements(MINUTES[1::3] + 0.5, log().values[1::3], sigma=0.8)
    return sf.Problem(room(), run(40.0, few, time_unit=unit), RATES | {"heating": 0.4, "cooling": 0.03})


def texts_of(figure):
    """All texts of a figure, drawn, in the order in which it holds them."""
    figure.canvas.draw()
    return "\n".join(text.get_text() for text in figure.findobj(Text))


def late_problem(bounds=()):
    """A delay of the log, in minutes, with or without bounds."""
    given = {"late": sf.Parameter(0.5, *bounds)}
    return sf.Problem(room(), run(30.0, log(delay="late"), time_unit="min"), RATES | given)


def simulate(on=on, **more):
    system = sf.HybridSystem({"on": on, "off": off}, [15.0], **more)
    return sf.simulate(sf.Problem(system, run(time_unit="min"), RATES))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: problem("min", min_duration=50.0), r"is 50\.0 min, but the guess gives mode 1 .* of run1 only 30 min"),
        (late_problem, r"may lie in \[-inf, inf\], .*only from -3 to 1 min"),
        (lambda: sf.evaluate(late_problem((0.0, 1.0)), [30.0, 0.3, 0.05, 3.0]), "are of moments from -2 to 114 min"),
        (lambda: simulate(lambda t, x, p: p["heating"] * jnp.sqrt(20.0 - t)), r"at t = 2\S* min, x = "),
        (lambda: simulate(lambda t, x, p: p["heating"] * x**2), r"beyond t = 0\.\S* min, where x = "),
        (lambda: simulate(reset_maps={("on", "off"): lambda t, x, p: x * np.nan}), "at t = 30 min, x = "),
    ],
    ids=["min_duration", "delay", "theta", "nan", "blows up", "reset map"],
)
def test_messages_have_times_in_their_unit(call, message):
    with pytest.raises(ValueError, match=message) as caught:
        call()
    assert not LONE_S.search(str(caught.value))


FILE, _, _ = PROBLEM.replace('name = "monday"', 'time_unit = "min"').partition("[options]")
FILE = FILE.replace("5.0", '5.0, unit = "min"')

UNIT = "{0} %"
"""A unit that does harm where texts are made of templates."""


class Said:
    """A fit and studies of it, whose times have a unit that does harm where texts are made of templates."""

    def __init__(self, path):
        self.problem = problem(UNIT, min_duration=1.0)
        self.fit = sf.estimate(self.problem)
        self.profile = self.fit.profile("run1.tau_1")
        self.study = sf.monte_carlo(self.problem, 5, theta=self.fit.theta)
        self.search = sf.multistart(self.problem, 2)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(derivative_check, "measure_closing_gap", lambda *given: (0.0, 0.0))  # most of the time
            self.fit.save(path)
        content = json.loads(path.read_text(encoding="utf-8"))
        del content["fit"]["seconds"]
        self.saved = json.dumps(content, ensure_ascii=False, indent=0)


@pytest.fixture(scope="module")
def said(tmp_path_factory):
    return Said(tmp_path_factory.mktemp("said") / "fit.json")


TEXTS = {
    "report": (lambda s: str(s.fit), ["on -> off, 0 to 120 {0} %\n", "known.tau_1  46"]),
    "identifiability": (lambda s: str(sf.identifiability(doubtful(UNIT))), ["{0} % later"]),
    "profile": (lambda s: str(s.profile), ["± 0.10 {0} %\n", "] {0} %   (likelihood ratio"]),
    "monte_carlo": (lambda s: str(s.study), ["run1.tau_1 ({0} %)"]),
    "multistart": (lambda s: str(s.search), ["run1.tau_1 = 42.9702 {0} %, heating = 0.50146 °C/min"]),
    "many": (lambda s: str(sf.estimate_many([s.problem] * 2)), ["run1.tau_1 ({0} %)"]),
    "summary": (lambda s: write_problem(s.problem), ["on [0, 120] {0} %, at 30 {0} %", "typically 4 {0} % apart"]),
    "json": (lambda s: s.saved, ['"theta_units": [\n"{0} %"', '"time_unit": "{0} %"']),
    "figure": (lambda s: texts_of(s.fit.plot()), ["time ({0} %)"]),
    "figure of residuals": (lambda s: texts_of(s.fit.plot_residuals()), ["time ({0} %)"]),
    "figure of a study": (lambda s: texts_of(s.study.plot()), ["run1.tau_1 ({0} %)"]),
    "prediction": (lambda s: s.fit.predict([5.0]).time_unit, [UNIT]),
}
"""What prints, draws, saves or raises a text, and parts of it: a time and its unit."""


@pytest.mark.parametrize("name", TEXTS)
def test_the_unit_of_times_is_printed_and_no_other(said, name):
    """No s anywhere, but for the time that the computer took."""
    write, parts = TEXTS[name]
    text = write(said)
    assert not LONE_S.search(without_wall_time(text))
    assert all(part in text for part in parts)


def test_times_without_a_unit():
    """The unit "1" is that of pure numbers, and not shown: as of parameters."""
    problem = sf.Problem(room(), run(time_unit="1"), RATES)
    fit = sf.estimate(problem, strategy="local")
    assert "on -> off, 0 to 120\n" in fit.report(full=True)
    assert fit.plot().axes[-1].get_xlabel() == "time"
    assert "on [0, 120], at 30\n" in write_problem(problem)


# --- each plot function, and several units at once --------------------------------------------------------------------


def test_each_experiment_has_its_own_unit(tmp_path):
    """One run in minutes, one in hours with rates of its own; no number of one is shown in the unit of the other."""
    hours = sf.Measurements(MINUTES / 60, log(46.0, 2).values, sigma=0.1, names=("T",))
    renamed = {"heating": "heating_h", "cooling": "cooling_h"}
    runs = [run(time_unit="min", name="first")]
    for name, tau in (("later", sf.Parameter(46 / 60, fixed=True)), ("third", 0.6)):
        own = {"name": name, "time_unit": "h", "parameter_map": renamed}
        runs.append(sf.Experiment(hours, ("on", "off"), (tau,), t0=0.0, tf=2.0, **own))
    per_hour = {"heating_h": sf.Parameter(18.0, unit="°C/h"), "cooling_h": sf.Parameter(3.0, unit="1/h")}
    whole = sf.Problem(room(), runs, RATES | per_hour)
    assert whole.unknowns.units == ("min", "h", "°C/min", "1/min", "°C/h", "1/h")
    fit = sf.estimate(whole)
    runs = r"first +on -> off, 0 to 120 min\n", r"later +on -> off, 0 to 2 h\n"
    assert all(re.search(pattern, str(fit)) for pattern in (*runs, r"later\.tau_1 +0\.7666\d+ +h"))
    assert [ax.get_xlabel() for ax in fit.plot().axes[1::2]] == ["time (min)", "time (h)", "time (h)"]
    assert [ax.get_xlabel() for ax in fit.plot_residuals().axes[::3]] == ["time (min)", "time (h)", "time (h)"]
    assert all(text in write_problem(whole) for text in ("typically 4 min apart", "typically 0.06667 h apart"))
    fit.save(tmp_path / "fit.json")
    loaded = sf.Estimate.load(tmp_path / "fit.json", problem=whole)
    assert str(loaded) == str(fit)
    assert [own.time_unit for own in loaded.trajectories] == ["min", "h", "h"]


# --- what is refused --------------------------------------------------------------------------------------------------


def twice(unit, **more):
    """A second transition time that has a unit of its own, in a run that has seconds."""
    return run((30.0, sf.Parameter(50.0, unit=unit, **more)), modes=("on", "off", "on"), time_unit="s")


def pose(*units, parameters=(), data=None, **more):
    runs = [run(data=data, time_unit=unit, name=f"in {unit}") for unit in units]
    return sf.Problem(room(), runs, RATES | dict(parameters), **more)


SECOND = {"late": sf.Parameter(0.5, lower=0.0, upper=1.0, unit="s")}


test_what_is_a_time_or_one_number_for_all_runs_has_one_unit = refused(
    (lambda: run(time_unit="\n\t"), "time_unit must not be empty; got"),
    (lambda: twice("min"), "transition time 2 has the unit 'min', but time_unit .* is 's'"),
    (lambda: twice("1", fixed=True), "transition time 2 has the unit '1', but time_unit .* is 's'"),
    (lambda: pose("min", data=log(delay="late"), parameters=SECOND), "delay 'late' has the unit 's', but .* 'min'"),
    (lambda: pose("min", "h", min_duration=1e-3), r"min_duration must be 0 .* different units \(h, min\); got"),
    (lambda: sf.estimate_many([pose("min"), pose("h")]), "problem 1 has its times in h, the first one in min"),
    error=ValueError,
)


def test_one_column_of_times_has_one_unit_and_so_has_one_run(tmp_path):
    (tmp_path / "room.py").write_text(ROOM)
    (tmp_path / "log.csv").write_text("t,T\n1,15\n5,16\n")
    path, out = tmp_path / "two.toml", tmp_path / "x.csv"
    path.write_text(FILE.replace('time_unit = "min"\n', ""))
    with pytest.raises(ValueError, match=r"experiments\[1\]: transition time 1 has the unit 'min', but"):
        load_problem(path)
    other = FILE.partition("[[experiments]]")[2]
    path.write_text(f"{FILE}\n[[experiments]]\n{other.replace('min', 'h')}")
    said = invoke("simulate", path, "--out", out, code=2).stderr
    assert "times in different units (h, min), and one column of the CSV file would mix them" in said
    assert not out.exists()
    path.write_text(f"{FILE}\n[[experiments]]\n{other}")
    invoke("simulate", path, "--out", out, code=0)
    assert out.read_text().splitlines()[0] == "experiment,t (min),mode,T"
