"""Malformed calls of everything that is public: each ends in a result, or in a sentence that names the argument.

`list_doors` is a catalogue of valid calls; `BAD` one of values that somebody may hand over by mistake. Every bad value
goes into every argument of every door, and inside those that have entries (fuzz: all of them; by default: a seeded
sample). What was accepted is used: data go into a problem, a problem is evaluated. By default what JAX would compile
for seconds is left out: a call that gets as far has been accepted.
"""

import datetime
import dis
import inspect
import itertools
import traceback
import warnings
from decimal import Decimal
from fractions import Fraction
from functools import cache, partial, reduce
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from support.models import charge as rise
from support.models import decay as fall
from switchfit.meshes.evaluator import Evaluator

pytestmark = pytest.mark.usefixtures("fits_one_by_one")

SOURCE = str(Path(sf.__file__).parent)
LONGEST = 600


def driven(t, x, p, u):
    return -p["k"] * x + u


def low(t, x, p):
    return x[0] - 0.6


def reset(t, x, p):
    return 0.5 * x


def final(x, p):
    return x[0] ** 2


TIMES = np.linspace(0.0, 1.0, 7)
VALUES = np.stack([np.exp(-TIMES), 0.5 * np.exp(-TIMES)], axis=1) + 0.01 * np.cos(40 * TIMES)[:, None]
SYSTEM = {"modes": {"fall": fall, "rise": rise}, "initial_state": [1.0, 0.5]}
DATA = {"times": TIMES, "values": VALUES, "sigma": [0.1, 0.1]}
RUN = {"mode_sequence": ("fall", "rise"), "transition_times": (0.4,), "t0": 0.0, "tf": 1.0}
PARAMETERS = {"k": sf.Parameter(1.0, 0.1, 5.0)}


def system(**changes):
    return sf.HybridSystem(**(SYSTEM | changes))


def measurements(**changes):
    return sf.Measurements(**(DATA | changes))


def experiment(data=None, **changes):
    return sf.Experiment(measurements() if data is None else data, **(RUN | changes))


def problem(run=None, of=None, **changes):
    given = {"parameters": PARAMETERS} | changes
    return sf.Problem(system() if of is None else of, experiment() if run is None else run, **given)


class Hostile:
    """Whatever is asked of it, it raises something that nobody expects."""

    def fail(self, *given, **options):
        raise RuntimeError("not this way")

    __array__ = __float__ = __index__ = __iter__ = __repr__ = fail


ENDLESS: list[Any] = []
ENDLESS.append(ENDLESS)
DEEP = reduce(lambda inner, _: [inner], range(200), 1.0)
MASKED = np.ma.array(VALUES, mask=VALUES > 0.9)


TEXTS = ["", "1.0", "word " * 100_000, b"1.0", np.str_("x")]
NUMBERS = [0, -1, 10**400, 10**6000, 2.5, np.nan, np.inf, 1e308, -1e308, 5e-324, 1j, np.longdouble("1e4000")]
NUMBERS += [True, Decimal("sNaN"), Fraction(10**400, 3), np.ma.masked, sf.Parameter([0.1, 0.2, 0.3])]
DATES = [np.datetime64("2020-01-01"), datetime.timedelta(seconds=1), np.array(["2020", "2021"], "datetime64[us]")]
ARRAYS = [np.array(1.0), np.zeros((2, 3, 4)), np.array([1.0, 2.0j]), np.array([True, False]), MASKED]
ARRAYS += [np.array([1.0, None], object), np.array(["fall", "rise"]), np.zeros(2, [("a", float)])]
ARRAYS += [jnp.array([0.1, 0.2], jnp.bfloat16), np.linspace(0.0, 1.0, 100_000)]
LISTS = [[], [None], [np.nan], [1.0, np.ma.masked], ["1.0", 2.0], [np.float32(0.1), 0.2], [[1.0], [2.0, 3.0]]]
LISTS += [[["fall"], "rise"], ("fall", "fall"), ("", "rise"), range(3), ENDLESS, DEEP, {0.1: 0, 0.2: 0}.keys()]
TABLES = [{}, {"a": 1.0}, {0: 1.0, 1: 2.0}, {"fall", "rise"}]
OBJECTS = [None, int, object(), Hostile(), lambda: None, lambda *given: "x", itertools.count()]
OWN = [measurements(), problem(), [problem(), problem()]]
BAD = [*TEXTS, *NUMBERS, *DATES, *ARRAYS, *LISTS, *TABLES, *OBJECTS, *OWN]
"""What somebody may hand over by mistake."""

WORDS = (
    *("at t =", "bound", "channel", "column", "cost", "entries", "estimate", "experiment", "file", "folder", "guard"),
    *("input", "jump", "known over", "latitude", "mode", "name", "observe", "parameter", "reach", "reset", "rows"),
    *("samples", "scale of", "sf.problem", "state", "tau", "the guess", "transition", "unknown", "unwrap", "values"),
    "x =",
)
"""What a message may name in place of an argument: something that the argument is about."""


# The doors


def used(built):
    """Evaluate a problem unless something would have to be compiled for it.

    Nor over a horizon of 1e308: the 200,000 steps after which the solver gives up take seconds.
    """
    if built.structures == GOOD.structures and built.experiments[0].tf < 1e6:
        sf.evaluate(built)
    return built


def build_data(kind, *others, **given):
    return used(problem(experiment([*others, kind(**given)])))


def build_input(**given):
    return problem(experiment(inputs=sf.Input(**given)), of=system(modes={"fall": driven, "rise": driven}))


def build_prior(kind, **given):
    return used(problem(parameters={"k": sf.Parameter(1.0, 0.1, 5.0, prior=kind(**given))}))


GOOD = problem()
ONLINE = problem(experiment(mode_sequence=("fall",), transition_times=()))
GUARDED = problem(of=system(guards={("fall", "rise"): low}))


@cache
def made(name):
    """What takes a while, made once: a fit, studies, a profile."""
    return {
        "fit": lambda: sf.estimate(GOOD),
        "many": lambda: sf.estimate_many([GOOD, GOOD]),
        "study": lambda: sf.monte_carlo(GOOD, 3, theta=GOOD.initial_theta),
        "starts": lambda: sf.multistart(GOOD, 2),
        "bootstrap": lambda: sf.bootstrap(made("fit"), 3),
        "profile": lambda: sf.profile(made("fit"), "k"),
        "prediction": lambda: sf.predict(made("fit")),
        "rates": lambda: sf.insertion(GOOD),
        "plan": lambda: sf.design(GOOD),
    }[name]()


def find_quietly(**given):
    """Search without the warning that min_duration leaves no room for so many switches."""
    with warnings.catch_warnings():
        return sf.find_modes(**given)


def of(name, method):
    return lambda **given: getattr(made(name), method)(**given)


WITH_A_LEVEL = {
    "fit": ["quantile", "confidence_intervals"],
    "many": ["confidence_intervals"],
    "study": ["confidence_intervals", "coverage"],
    "starts": ["confidence_intervals"],
    "bootstrap": ["intervals", "confidence_intervals"],
    "profile": ["regions", "interval"],
    "prediction": ["state_band", "output_band", "prediction_band"],
}
"""What is made, and its methods that take a level."""
STUDIES = ("many", "study", "starts", "bootstrap")

START = [0.45, 1.1]
SUCCESSIONS = {"fall": ("rise",), "rise": ()}


def door(call, target=None, **given):
    """A call, and arguments with which it succeeds: those given, and the defaults of all others that there are."""
    parameters = inspect.signature(target or call).parameters.values()
    return call, {each.name: each.default for each in parameters if each.default is not each.empty} | given


def list_doors():
    """All doors by name; made when a test runs: some need a fit."""
    fit = made("fit")
    fit.save("saved.json")
    Path("log.csv").write_text("t,x,yaw\n0,1,0\n1,2,3\n2,3,-3\n")
    maps = {"reset_maps": {("fall", "rise"): reset}, "guards": {("fall", "rise"): low}}
    return {
        "HybridSystem": door(
            lambda **given: used(problem(of=sf.HybridSystem(**given))),
            sf.HybridSystem,
            **(SYSTEM | maps | {"state_names": ("a", "b"), "state_units": ("m", "m")}),
        ),
        "Experiment": door(
            lambda **given: used(problem(sf.Experiment(**given))),
            sf.Experiment,
            **(RUN | {"data": [measurements()], "initial_state": [1.0, 0.5], "name": "drive"}),
            parameter_map={"k": "k"},
            jumps=[sf.Jump(0.7, reset)],
        ),
        "Jump": door(lambda **given: used(problem(experiment(jumps=[sf.Jump(**given)]))), time=[0.2, 0.7], map=reset),
        "Problem": door(
            lambda **given: used(sf.Problem(**given)),
            sf.Problem,
            system=system(),
            experiments=[experiment()],
            parameters=PARAMETERS,
        ),
        "Parameter": door(
            lambda **given: used(problem(parameters={"k": sf.Parameter(**given)})),
            sf.Parameter,
            **{"value": 1.0, "lower": 0.1, "upper": 5.0, "prior": sf.Normal(1.0, 0.5)},
        ),
        "Normal": door(partial(build_prior, sf.Normal), sf.Normal, mean=1.0, sd=0.5),
        "LogNormal": door(partial(build_prior, sf.LogNormal), sf.LogNormal, median=1.0, log_sd=0.5),
        "Measurements": door(
            partial(build_data, sf.Measurements),
            sf.Measurements,
            **(DATA | {"names": ("a", "b"), "loss": "huber", "loss_scale": 2.0, "units": ("m", "rad")}),
        ),
        "ReferenceSignal": door(
            partial(build_data, sf.ReferenceSignal.from_samples),
            sf.ReferenceSignal.from_samples,
            **{"times": TIMES, "values": VALUES, "lowpass_hz": 2.0, "weights": [1.0, 2.0]},
        ),
        "RunningCost": door(partial(build_data, sf.RunningCost), ell=low),
        "TransitionCost": door(partial(build_data, sf.TransitionCost), sf.TransitionCost, mu=low),
        "TerminalCost": door(partial(build_data, sf.TerminalCost), phi=final),
        "TerminalConstraint": door(partial(build_data, sf.TerminalConstraint, measurements()), psi=final),
        "Input": door(build_input, sf.Input, times=TIMES, values=TIMES, kind="linear", units=("m",)),
        "from_epoch": door(sf.from_epoch, numbers=[1.6e9, 1.7e9]),
        "read_log": door(sf.read_log, path="log.csv", columns=["x", "yaw"], time="t", repair=("sort", "unwrap:yaw")),
        "estimate": door(sf.estimate, problem=GOOD, start=START),
        "estimate_many": door(sf.estimate_many, problems=[GOOD]),
        "evaluate": door(sf.evaluate, problem=GOOD, theta=START),
        "find_modes": door(
            find_quietly, sf.find_modes, problem=GOOD, successions=SUCCESSIONS, max_switches=1, starts=[[1.1]], seed=0
        ),
        "OnlineEstimator": door(
            sf.OnlineEstimator,
            **{"problem": ONLINE, "successions": SUCCESSIONS, "window": 1.0, "min_duration": {"fall": 0.0}},
            **{"max_switches": 2, "renews": {"rise": "k"}, "drift": {"k": 0.1}},
        ),
        "OnlineEstimator.update": door(
            lambda **given: sf.OnlineEstimator(ONLINE).update(**given),
            sf.OnlineEstimator(ONLINE).update,
            **{"t": 0.5, "y": [0.1, 0.2]},
        ),
        "replay": door(sf.replay, problem=ONLINE),
        "calibrate": door(lambda **given: sf.calibrate(sf.OnlineEstimator(ONLINE), **given), false_alarms=0.1),
        "insertion": door(sf.insertion, problem=GOOD, theta=START),
        "Insertion.minima": door(made("rates").minima),
        "evaluate_on_guards": door(sf.evaluate_on_guards, problem=GUARDED, theta=START),
        "simulate": door(sf.simulate, problem=GOOD, theta=START),
        "check_derivatives": door(sf.check_derivatives, problem=GOOD, theta=START),
        "identifiability": door(sf.identifiability, subject=GOOD),
        "design": door(sf.design, problem=GOOD, theta=START, free={}, names={"k": 1.0}, criterion="A", samples=3),
        "Design.save": door(made("plan").save, path="design.json"),
        "monte_carlo": door(sf.monte_carlo, problem=GOOD, start=START, theta=START, runs=2, noise=[0.1, 0.1]),
        "multistart": door(sf.multistart, problem=GOOD, starts=[[0.4, 1.0]]),
        "bootstrap": door(sf.bootstrap, estimate=fit, runs=2, resample="blocks", block=2),
        "predict": door(sf.predict, estimate=fit, times=TIMES),
        "Estimate.validate": door(fit.validate, other=GOOD),
        "compare": door(sf.compare, estimates=[fit, fit], names=["one", "two"]),
        "profile": door(sf.profile, estimate=fit, name="k", callback=lambda done, total: done > 1),
        "Estimate.plot": door(fit.plot, bands=False),
        "Estimate.save": door(fit.save, path="fit.json"),
        "Estimate.load": door(sf.Estimate.load, path="saved.json", problem=GOOD),
        "Estimate.covariance_from": door(fit.covariance_from, hessian="exact"),
        **{
            f"{name}.{method}": (of(name, method), {"level": 0.9})
            for name, methods in WITH_A_LEVEL.items()
            for method in methods
        },
    }


# What may come out


class AcceptedError(Exception):
    """A call has got as far as what takes long."""


def take_long(*args, **kwargs):
    raise AcceptedError


def raised_by_switchfit(error):
    """Whether a `raise` in switchfit raised it, and not something that it called."""
    last = error.__traceback__
    while last.tb_next is not None:
        last = last.tb_next
    code = last.tb_frame.f_code
    if not code.co_filename.startswith(SOURCE):
        return False
    operations = {step.offset: step.opname for step in dis.get_instructions(code)}
    return operations[last.tb_lasti] == "RAISE_VARARGS"


def complaint(call, given, argument):
    """What is wrong with how a call ended; None for a result, or for an error as it has to be."""
    try:
        call(**given)
    except AcceptedError:
        return None
    except OSError as error:
        return None if argument in ("path", "folder") else f"bare {error!r:.200}"
    except Exception as error:
        message = str(error)
        if not isinstance(error, (ValueError, TypeError)) or not raised_by_switchfit(error):
            *_, place = traceback.extract_tb(error.__traceback__)
            return f"bare {type(error).__name__} at {place.filename}:{place.lineno}: {message[:200]}"
        if not any(word in message.lower() for word in (*map(str.lower, given), *WORDS)):
            return f"names no argument: {message[:300]}"
        if not message.endswith((".", ".)")):
            return f"is no sentence: {message[:300]}"
        if len(message) > LONGEST:
            return f"is {len(message)} characters long: {message[:300]}"
    return None


def calls_of(doors):
    """All ways to put one bad value into one argument: (door, argument, place, number of the bad value)."""
    return [
        (name, argument, place, bad)
        for name, (_, valid) in doors.items()
        for argument, value in valid.items()
        for place in places_in(value)
        for bad in range(len(BAD))
    ]


def places_in(value):
    if isinstance(value, dict) and value:
        return "whole", "entry", "key"
    return ("whole", "entry") if isinstance(value, (list, tuple, np.ndarray)) and len(value) > 0 else ("whole",)


def put(bad, place, value):
    """A valid value with a bad one in its place, or in that of its first entry or key."""
    if place == "whole":
        return bad
    if not isinstance(value, dict):
        first, *others = value
        return [put(bad, place, first) if isinstance(first, (list, np.ndarray)) else bad, *others]
    (key, first), *others = value.items()
    if place == "entry":
        return {key: bad, **dict(others)}
    try:
        return {bad: first, **dict(others)}
    except Exception:  # no key
        return {None: first, **dict(others)}


def complaints(doors, calls):
    """What is wrong with the ends of all these calls."""
    found = []
    for name, argument, place, k in calls:
        call, valid = doors[name]
        wrong = complaint(call, valid | {argument: put(BAD[k], place, valid[argument])}, argument)
        if wrong is not None:
            found.append(f"{name}({argument}: number {k}, a {type(BAD[k]).__name__}, as {place}) {wrong}")
    return found


@pytest.fixture
def doors(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return list_doors()


OVERFLOWS = pytest.mark.filterwarnings("ignore:.*(overflow|invalid value|divide by zero):RuntimeWarning")
"""Near the largest double costs overflow: NumPy warns, the result is infinite and says so, and no call crashes."""


def test_the_doors_are_all_that_is_public(doors):
    """What is missing here is made by switchfit, not by users."""
    made_by_switchfit = {
        "ActiveConstraint", "Alarm", "Bootstrap", "Calibration", "Certificate", "ChannelResiduals", "Comparison",
        "DerivativeCheck", "Design", "Direction", "Estimate", "Evaluation", "Fits", "GuardedEvaluation",
        "Identifiability", "InputCorrelation", "Insertion", "Issue", "Kink", "Log", "ModeEnding",
        "ModeFit", "ModeSearch", "ModeStatus", "ModeWarning", "ModelComparison", "MonteCarlo", "Multistart", "Now",
        "OnlineLog", "OnlineStatus", "Prediction", "Profile", "ResidualDiagnostics", "SearchProgress", "Status",
        "Step", "Stiffness", "Termination", "Trajectory", "Validation", "Verdict",
    }  # fmt: skip
    assert set(sf.__all__) - made_by_switchfit <= set(doors)


@pytest.mark.fuzz
def test_the_valid_calls_succeed(doors):
    for name, (call, valid) in doors.items():
        try:
            call(**valid)
        except Exception as error:
            raise AssertionError(f"{name}: {error}") from error


@OVERFLOWS
def test_some_malformed_calls(doors, monkeypatch):
    monkeypatch.setattr("switchfit.batch.study.Batch.fit", take_long)
    monkeypatch.setattr(Evaluator, "constrained", take_long)
    monkeypatch.setattr("switchfit.uncertainty.derivative_check.measure_derivative_gap", take_long)
    calls = [call for call in calls_of(doors) if not call[0].startswith(STUDIES)]
    rng = np.random.default_rng(12)
    assert complaints(doors, [calls[k] for k in rng.choice(len(calls), 700, replace=False)]) == []


@OVERFLOWS
@pytest.mark.fuzz
def test_every_malformed_call(doors):
    calls = calls_of(doors)
    assert len(calls) > 6500
    assert complaints(doors, calls) == []
