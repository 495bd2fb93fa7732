"""Malformed calls of everything that is public: each ends in a result, or in a sentence that names the argument.

`DOORS` is a catalogue of valid calls; `BAD` a catalogue of values that somebody may hand over by mistake. Every bad
value goes into every argument of every door, alone (slow: all of them; by default: a seeded sample), and into two
arguments at once (a seeded sample). What was accepted is used: data go into a problem, a problem is evaluated. By
default what JAX would compile for seconds is left out: a call that gets as far has been accepted.
"""

import datetime
import dis
import itertools
import signal
import traceback
import warnings
from collections import deque
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass, field
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from models import charge as rise
from models import decay as fall

import switchfit as sf
from switchfit.fit.evaluator import Evaluator

pytestmark = pytest.mark.usefixtures("fits_one_by_one")

SOURCE = str(Path(sf.__file__).parent)
SECONDS = 20
SECONDS_LONG = 120
"""For calls that compile a program of JAX or simulate many runs: 10 s each where nothing else runs."""
LONGEST = 600


def driven(t, x, p, u):
    return -p["k"] * x + u


def low(t, x, p):
    return x[0] - 0.6


def reset(t, x, p):
    return 0.5 * x


def energy(t, x, p):
    return x[0] ** 2


def final(x, p):
    return x[0] ** 2


def noisy(rng, clean, item):
    return clean + 0.01 * rng.standard_normal(clean.shape)


def stop(done, total):
    return False


def watch(record):
    return False


TIMES = np.linspace(0.0, 1.0, 7)
VALUES = np.stack([np.exp(-TIMES), 0.5 * np.exp(-TIMES)], axis=1) + 0.01 * np.cos(40 * TIMES)[:, None]
SYSTEM = {"modes": {"fall": fall, "rise": rise}, "initial_state": [1.0, 0.5]}
DATA = {"times": TIMES, "values": VALUES, "sigma": 0.1}
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


# What each mistake looks like


class Hostile:
    """Whatever is asked of it, it raises something that nobody expects."""

    def __array__(self, dtype=None, copy=None):
        raise RuntimeError("no array")

    def __float__(self):
        raise RuntimeError("no number")

    def __index__(self):
        raise RuntimeError("no index")

    def __iter__(self):
        raise RuntimeError("no entries")

    def __repr__(self):
        raise RuntimeError("no text")


class Dates:
    """As a DatetimeIndex of pandas: NumPy reads it as dates."""

    def __array__(self, dtype=None, copy=None):
        return np.array(["2020-01-01", "2020-01-02"], dtype="datetime64[ns]")


def endless_list():
    found: list[Any] = []
    found.append(found)
    return found


def deep(depth=200):
    found: Any = 1.0
    for _ in range(depth):
        found = [found]
    return found


BAD: dict[str, Callable[[], Any]] = {
    "None": lambda: None,
    "True": lambda: True,
    "False": lambda: False,
    "0": lambda: 0,
    "-1": lambda: -1,
    "1": lambda: 1,
    "10**400": lambda: 10**400,
    "-10**400": lambda: -(10**400),
    "10**6000": lambda: 10**6000,
    "0.0": lambda: 0.0,
    "2.5": lambda: 2.5,
    "nan": lambda: float("nan"),
    "inf": lambda: float("inf"),
    "-inf": lambda: -float("inf"),
    "1e308": lambda: 1e308,
    "-1e308": lambda: -1e308,
    "5e-324": lambda: 5e-324,
    "1j": lambda: 1j,
    "empty text": lambda: "",
    "blank": lambda: " ",
    "x": lambda: "x",
    "1.0 as text": lambda: "1.0",
    "long text": lambda: "word " * 100_000,
    "bytes": lambda: b"1.0",
    "bytearray": lambda: bytearray(b"12"),
    "[]": lambda: [],
    "()": lambda: (),
    "{}": lambda: {},
    "set()": lambda: set(),
    "a set": lambda: {1.0, 2.0},
    "a set of text": lambda: {"fall", "rise"},
    "a dict": lambda: {"a": 1.0},
    "a dict of numbers": lambda: {0: 1.0, 1: 2.0},
    "a generator": lambda: (value for value in (1.0, 2.0)),
    "an endless iterator": itertools.count,
    "a range": lambda: range(3),
    "a deque": lambda: deque([1.0, 2.0]),
    "a function without arguments": lambda: lambda: None,
    "a function that returns None": lambda: lambda *given: None,
    "a function that returns text": lambda: lambda *given: "x",
    "a class": lambda: int,
    "a module": lambda: np,
    "an object": object,
    "hostile": Hostile,
    "Ellipsis": lambda: ...,
    "a date": lambda: np.datetime64("2020-01-01"),
    "a time difference": lambda: np.timedelta64(1, "s"),
    "a datetime": lambda: datetime.datetime(2020, 1, 1),
    "a timedelta": lambda: datetime.timedelta(seconds=1),
    "dates": lambda: np.array(["2020-01-01", "2020-01-02"], dtype="datetime64[us]"),
    "dates in a list": lambda: [datetime.datetime(2020, 1, 1), datetime.datetime(2020, 1, 2)],
    "an index of dates": Dates,
    "masked": lambda: np.ma.masked,
    "a masked array": lambda: np.ma.array([1.0, 2.0], mask=[False, True]),
    "masked values": lambda: np.ma.array(VALUES, mask=VALUES > 0.9),
    "a masked entry": lambda: [1.0, np.ma.masked],
    "an array of objects": lambda: np.array([1.0, None], dtype=object),
    "an array of text": lambda: np.array(["fall", "rise"]),
    "text among numbers": lambda: ["1.0", 2.0],
    "an array without dimensions": lambda: np.array(1.0),
    "an empty array": lambda: np.array([]),
    "three dimensions": lambda: np.zeros((2, 3, 4)),
    "complex numbers": lambda: np.array([1.0, 2.0j]),
    "truth values": lambda: np.array([True, False]),
    "a structured array": lambda: np.zeros(2, dtype=[("a", float)]),
    "float32": lambda: np.float32(0.1),
    "float16": lambda: np.float16(0.1),
    "float32 in a list": lambda: [np.float32(0.1), 0.2],
    "float32 array": lambda: np.array([0.1, 0.2], dtype=np.float32),
    "jnp number": lambda: jnp.array(0.1, dtype=jnp.float32),
    "jnp array": lambda: jnp.array([0.1, 0.2], dtype=jnp.float32),
    "bfloat16": lambda: jnp.array([0.1, 0.2], dtype=jnp.bfloat16),
    "longdouble": lambda: np.longdouble("1e4000"),
    "ragged": lambda: [[1.0], [2.0, 3.0]],
    "nested text": lambda: [[["a"]]],
    "nested names": lambda: [["fall"], "rise"],
    "the same name twice": lambda: ("fall", "fall"),
    "an empty name": lambda: ("", "rise"),
    "a list of itself": endless_list,
    "200 deep": deep,
    "[None]": lambda: [None],
    "[True]": lambda: [True],
    "[nan]": lambda: [float("nan")],
    "a large list": lambda: [0.5] * 100_000,
    "a large array": lambda: np.linspace(0.0, 1.0, 100_000),
    "Decimal": lambda: Decimal("0.1"),
    "a signalling Decimal": lambda: Decimal("sNaN"),
    "Fraction": lambda: Fraction(1, 3),
    "a large Fraction": lambda: Fraction(10**400, 3),
    "np.int64": lambda: np.int64(1),
    "np.bool_": lambda: np.True_,
    "np.str_": lambda: np.str_("x"),
    "a parameter": lambda: sf.Parameter(0.5),
    "a parameter of three": lambda: sf.Parameter([0.1, 0.2, 0.3]),
    "measurements": measurements,
    "a problem": problem,
    "a list of problems": lambda: [problem(), problem()],
    "sf.Problem itself": lambda: sf.Problem,
}


# The doors


@dataclass(frozen=True)
class Door:
    """A valid call.

    Attributes
    ----------
    call : function of keyword arguments
    valid : arguments with which it succeeds
    words : for an argument the words of which a message about it has one; its own name if left out
    inside : for an argument a function that puts a bad value inside a good one, where `put_inside` cannot
    seconds : after which a call hangs
    """

    call: Callable[..., Any]
    valid: dict[str, Any]
    words: dict[str, tuple[str, ...]] = field(default_factory=dict)
    inside: dict[str, Callable[[Any], Any]] = field(default_factory=dict)
    seconds: int = SECONDS


def used(built):
    """Evaluate a problem unless something would have to be compiled for it.

    Nor over a horizon of 1e308: the 200,000 steps after which the solver gives up take seconds.
    """
    if built.structures == GOOD.structures and built.experiments[0].tf < 1e6:
        sf.evaluate(built)
    return built


def build_experiment(**given):
    return used(problem(sf.Experiment(**given)))


def build_measurements(**given):
    return used(problem(experiment(sf.Measurements(**given))))


def build_reference(**given):
    return problem(experiment(sf.ReferenceSignal.from_samples(**given)))


def build_input(**given):
    modes = {"fall": driven, "rise": driven}
    return problem(experiment(inputs=sf.Input(**given)), of=system(modes=modes))


def build_system(**given):
    return used(problem(of=sf.HybridSystem(**given)))


def build_parameter(**given):
    return used(problem(parameters={"k": sf.Parameter(**given)}))


def build_problem(**given):
    return used(sf.Problem(**given))


def build_prior(kind):
    return lambda **given: used(problem(parameters={"k": sf.Parameter(1.0, 0.1, 5.0, prior=kind(**given))}))


GOOD = problem()
ONLINE = problem(experiment(mode_sequence=("fall",), transition_times=()))
GUARDED = problem(of=system(guards={("fall", "rise"): low}))
FITS: dict[str, Any] = {}


def made(name):
    """What takes a while, made once: a fit, studies, a profile."""
    if name not in FITS:
        FITS[name] = {
            "fit": lambda: sf.estimate(GOOD),
            "two": lambda: sf.estimate(problem([experiment(), experiment()])),
            "many": lambda: sf.estimate_many([GOOD, GOOD]),
            "study": lambda: sf.monte_carlo(GOOD, 3, theta=GOOD.initial_theta),
            "starts": lambda: sf.multistart(GOOD, 2),
            "bootstrap": lambda: sf.bootstrap(made("fit"), 3),
            "profile": lambda: sf.profile(made("fit"), "k"),
            "prediction": lambda: sf.predict(made("fit")),
            "rates": lambda: sf.insertion(GOOD),
            "plan": lambda: sf.design(GOOD),
        }[name]()
    return FITS[name]


def find_quietly(**given):
    """Search without the warning that min_duration leaves no room for so many switches."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "max_switches is .* leave room", UserWarning)
        return sf.find_modes(**given)


def of(name, method):
    return lambda **given: getattr(made(name), method)(**given)


LONG = {"seed": 0, "tolerance": 1e-7, "max_iterations": 20, "client": None, "folder": None, "callback": stop}
WITH_A_LEVEL = (
    ("Estimate", "fit", ["quantile"]),
    ("Fits", "many", ["confidence_intervals"]),
    ("MonteCarlo", "study", ["confidence_intervals", "coverage"]),
    ("Multistart", "starts", ["confidence_intervals"]),
    ("Bootstrap", "bootstrap", ["intervals", "confidence_intervals"]),
    ("Profile", "profile", ["regions", "interval"]),
    ("Prediction", "prediction", ["state_band", "output_band", "prediction_band"]),
)
"""Class, what is made of it, and the methods that take a level."""

THETA = {"theta": [0.45, 1.1]}
THETA_WORDS = {"theta": ("theta", "tau", "transition times", "at the guess", "the guess leads")}
SYSTEM_WORDS = {
    "modes": ("mode",),
    "reset_maps": ("reset",),
    "guards": ("guard",),
    "initial_state": ("initial_state", "state", "the guess leads"),
}
PROBLEM = {"system": system(), "experiments": experiment(), "parameters": PARAMETERS}
PROBLEM_WORDS = {"parameters": ("parameter", "mode"), "experiments": ("experiment",)}
DATA_WORDS = {
    "times": ("times", "samples", "values", "ReferenceSignal must reach"),
    "values": ("values", "rows", "channel", "observe", "entries", "samples"),
    "sigma": ("sigma",),
    "names": ("names",),
    "weights": ("weights",),
    "units": ("units",),
    "observe": ("observe",),
}


def catalogue():
    """All doors by name; built when a test runs, since some need a fit."""
    return {
        "HybridSystem": Door(
            build_system,
            SYSTEM
            | {"reset_maps": {("fall", "rise"): reset}, "guards": {}}
            | {"state_names": ("a", "b"), "state_units": ("m", "m")},
            words=SYSTEM_WORDS,
            inside={"guards": lambda bad: {("fall", "rise"): bad}},
        ),
        "mode names": Door(
            build_system, SYSTEM, words=SYSTEM_WORDS, inside={"modes": lambda bad: SYSTEM["modes"] | keyed(bad, fall)}
        ),
        "Experiment": Door(
            build_experiment,
            {"data": measurements()}
            | RUN
            | {"inputs": None, "initial_state": [1.0, 0.5], "name": "drive", "parameter_map": {"k": "k"}}
            | {"jumps": [sf.Jump(0.7, reset)]},
            words={
                "jumps": ("jump", "Jump"),
                "transition_times": ("transition", "tau"),
                "t0": ("t0", "at t ="),
                "tf": ("tf", "t ="),
                "initial_state": ("initial_state", "state", "x ="),
                "mode_sequence": ("mode_sequence",),
                "inputs": ("input", "mode"),
                "name": ("name",),
            },
            inside={"data": lambda bad: [measurements(), bad]},
        ),
        "Jump": Door(
            lambda **given: used(problem(experiment(jumps=[sf.Jump(**given)]))),
            {"time": [0.2, 0.7], "map": reset},
            words={"time": ("Jump",), "map": ("Jump",)},
        ),
        "Problem": Door(
            build_problem,
            PROBLEM | {"min_duration": 0.0, "solver": "explicit", "rtol": 1e-6, "atol": 1e-8},
            words=PROBLEM_WORDS,
            inside={"experiments": lambda bad: [experiment(), bad]},
        ),
        "parameter names": Door(
            build_problem, PROBLEM, words=PROBLEM_WORDS, inside={"parameters": lambda bad: {"k": 1.0} | keyed(bad, 2.0)}
        ),
        "Parameter": Door(
            build_parameter,
            {"value": 1.0, "lower": 0.1, "upper": 5.0, "unit": "1/s", "fixed": False}
            | {"prior": sf.Normal(1.0, 0.5), "scale": "linear"},
            words=dict.fromkeys(("value", "lower", "upper"), ("value", "bound", "lower", "upper", "'k'", "mode")),
            inside={"value": lambda bad: [bad], "lower": lambda bad: [bad]},
        ),
        "Normal": Door(build_prior(sf.Normal), {"mean": 1.0, "sd": 0.5}, words={"mean": ("mean", "cost")}),
        "LogNormal": Door(build_prior(sf.LogNormal), {"median": 1.0, "log_sd": 0.5}, words={"median": ("median",)}),
        "Measurements": Door(
            build_measurements,
            DATA
            | {"observe": None, "names": ("a", "b"), "loss": "huber", "loss_scale": 2.0}
            | {"delay": 0.0, "units": ("m", "rad")},
            words=DATA_WORDS,
            inside={"sigma": lambda bad: [bad, 0.1]},
        ),
        "ReferenceSignal": Door(
            build_reference,
            {"times": TIMES, "values": VALUES, "observe": None, "lowpass_hz": 2.0}
            | {"weights": [1.0, 2.0], "names": None, "units": None},
            words=DATA_WORDS,
        ),
        "Input": Door(
            build_input,
            {"times": TIMES, "values": TIMES, "kind": "linear", "units": ("m",)},
            words={"times": ("times", "samples", "known over"), "values": ("values", "rows", "mode", "samples")},
        ),
        "from_epoch": Door(sf.from_epoch, {"numbers": [1.6e9, 1.7e9], "unit": "s"}, words={"unit": ("s", "ms")}),
        "read_log": Door(
            sf.read_log,
            {"path": log_file(), "columns": ["x", "yaw"], "time": "t", "time_unit": "ms", "topic": None}
            | {"origin": None, "repair": ("sort", "unwrap:yaw")},
            words={
                "columns": ("columns", "column", "unwrap"),
                "time": ("time must", "column"),
                "path": ("file", "path", "folder"),
            }
            | {"origin": ("origin", "latitude"), "topic": ("topic",)},
            inside={"origin": lambda bad: [bad, 1.0]},
        ),
        "RunningCost": Door(lambda **given: problem(experiment(sf.RunningCost(**given))), {"ell": energy}),
        "TransitionCost": Door(
            lambda **given: problem(experiment(sf.TransitionCost(**given))),
            {"mu": lambda t, x, p: x[0], "before": None, "after": None},
        ),
        "TerminalCost": Door(lambda **given: problem(experiment(sf.TerminalCost(**given))), {"phi": final}),
        "TerminalConstraint": Door(
            lambda **given: problem(experiment([measurements(), sf.TerminalConstraint(**given)])), {"psi": final}
        ),
        "estimate": Door(
            sf.estimate,
            {"problem": GOOD, "hessian": "exact", "tolerance": 1e-7, "max_iterations": 20, "callback": watch}
            | {"start": [0.45, 1.1]},
            words={"start": ("start", "at the guess", "the guess leads")},
        ),
        "estimate_many": Door(
            sf.estimate_many,
            {"problems": [GOOD]} | {key: value for key, value in LONG.items() if key != "seed"},
            words={"problems": ("problem",)},
            seconds=SECONDS_LONG,
        ),
        "evaluate": Door(sf.evaluate, {"problem": GOOD, "method": "auto"} | THETA, words=THETA_WORDS),
        "find_modes": Door(
            find_quietly,
            {"problem": GOOD, "library": ("fall", "rise"), "first": "fall", "last": "rise"}
            | {"successions": {"fall": ("rise",), "rise": ()}, "min_duration": 0.0, "max_switches": 1}
            | {"criterion": "bic", "method": "beam", "width": 4, "grid": 0.25, "starts": [[1.1]], "seed": 0},
            words={"problem": ("find_modes needs", "problem")},
        ),
        "OnlineEstimator": Door(
            sf.OnlineEstimator,
            {"problem": ONLINE, "window": 1.0, "threshold": 12.0}
            | {"successions": {"fall": ("rise",), "rise": ()}, "min_duration": 0.0, "max_switches": 2}
            | {"renews": {"rise": "k"}, "drift": {"k": 0.1}, "budget": 1.0, "capacity": 16, "width": 4},
            inside={"min_duration": lambda bad: {"fall": bad}},
        ),
        "keys of OnlineEstimator": Door(
            sf.OnlineEstimator,
            {"problem": ONLINE, "window": 1.0, "renews": {"rise": "k"}, "drift": {"k": 0.1}},
            inside={"renews": lambda bad: keyed(bad, "k"), "drift": lambda bad: keyed(bad, 0.1)},
        ),
        "OnlineEstimator.update": Door(
            lambda **given: sf.OnlineEstimator(ONLINE).update(**given),
            {"t": 0.5, "y": [0.1, 0.2]},
        ),
        "replay": Door(sf.replay, {"problem": ONLINE}),
        "calibrate": Door(
            lambda **given: sf.calibrate(sf.OnlineEstimator(ONLINE), **({"false_alarms": 0.1} | given)),
            {"false_alarms": 0.1},
            seconds=SECONDS_LONG,
        ),
        "insertion": Door(sf.insertion, {"problem": GOOD} | THETA, words=THETA_WORDS),
        "Insertion.minima": Door(of("rates", "minima"), {"count": 2}),
        "evaluate_on_guards": Door(
            sf.evaluate_on_guards, {"problem": GUARDED} | THETA, words=THETA_WORDS, seconds=SECONDS_LONG
        ),
        "simulate": Door(sf.simulate, {"problem": GOOD, "experiment": 0} | THETA, words=THETA_WORDS),
        "check_derivatives": Door(
            sf.check_derivatives, {"problem": GOOD, "seed": 0} | THETA, words=THETA_WORDS, seconds=SECONDS_LONG
        ),
        "identifiability": Door(
            sf.identifiability, {"subject": GOOD}, words={"subject": ("identifiability needs an sf.Estimate",)}
        ),
        "design": Door(
            sf.design,
            {"problem": GOOD, "free": {}, "names": {"k": 1.0}, "criterion": "A", "samples": 3, "experiment": 0}
            | {"sensors": 1, "budget": None, "starts": 1, "seed": 0}
            | THETA,
            words=THETA_WORDS | {"names": ("names", "scale of k")},
        ),
        "Design.save": Door(of("plan", "save"), {"path": "design.json"}),
        "monte_carlo": Door(
            sf.monte_carlo,
            {"problem": GOOD, "runs": 2, "start": [0.45, 1.1], "noise": 0.1} | THETA | LONG,
            words=THETA_WORDS | {"start": ("start", "at the guess", "the guess leads")},
            seconds=SECONDS_LONG,
            inside={"noise": lambda bad: [bad, 0.1]},
        ),
        "multistart": Door(
            sf.multistart,
            {"problem": GOOD, "starts": 2} | LONG,
            words={"starts": ("start",)},
            seconds=SECONDS_LONG,
            inside={"starts": lambda bad: [[0.4, bad]]},
        ),
        "bootstrap": Door(
            sf.bootstrap,
            {"estimate": made("fit"), "runs": 2, "resample": "blocks", "block": 2} | LONG,
            words={"estimate": ("bootstrap needs the result of sf.estimate",)},
            seconds=SECONDS_LONG,
        ),
        "predict": Door(
            sf.predict,
            {"estimate": made("fit"), "times": TIMES, "experiment": 0},
            words={"estimate": ("predict needs the result of sf.estimate",)},
        ),
        "Estimate.validate": Door(of("fit", "validate"), {"other": GOOD, "refit": ()}),
        "compare": Door(
            sf.compare,
            {"estimates": [made("fit"), made("fit")], "names": ["one", "two"]},
            words={"estimates": ("compare needs", "estimates must be")},
        ),
        "log_posterior": Door(
            sf.log_posterior, {"problem": GOOD}, words={"problem": ("log_posterior needs an sf.Problem",)}
        ),
        "profile": Door(
            sf.profile,
            {"estimate": made("fit"), "name": "k", "level": 0.9, "callback": lambda done, total: done > 1},
            words={"estimate": ("profile needs the result of sf.estimate",), "name": ("name", "there is no unknown")},
        ),
        "Estimate.profile": Door(
            of("fit", "profile"),
            {"name": "k", "level": 0.9, "callback": lambda done, total: done > 1},
            words={"name": ("name", "there is no unknown")},
        ),
        "Estimate.predict": Door(of("fit", "predict"), {"times": TIMES, "experiment": 0}),
        "Estimate.plot": Door(of("fit", "plot"), {"bands": False, "level": 0.9}),
        "Estimate.save": Door(of("fit", "save"), {"path": "fit.json"}),
        "Estimate.load": Door(sf.Estimate.load, {"path": saved(), "problem": GOOD}),
        "Estimate.confidence_intervals": Door(
            of("fit", "confidence_intervals"), {"level": 0.9, "hessian": "gauss-newton"}
        ),
        "Estimate.covariance_from": Door(of("fit", "covariance_from"), {"hessian": "exact"}),
        **{
            f"{kind}.{method}": Door(of(name, method), {"level": 0.9})
            for kind, name, methods in WITH_A_LEVEL
            for method in methods
        },
    }


def keyed(bad, value):
    """A dict with a bad value as its key, if it can be one."""
    try:
        return {bad: value}
    except Exception:
        return {None: value}


def saved():
    path = Path("saved.json").resolve()
    made("fit").save(path)
    return path


def log_file():
    path = Path("log.csv").resolve()
    path.write_text("t,x,yaw\n0,1,0\n1,2,3\n2,3,-3\n")
    return path


# What may come out


class AcceptedError(Exception):
    """A call has got as far as what takes long."""


def take_long(*args, **kwargs):
    raise AcceptedError


class HangError(BaseException):
    """No except clause for Exception stops it."""


@contextmanager
def no_hang(seconds):
    def give_up(number, frame):
        raise HangError

    before = signal.signal(signal.SIGALRM, give_up)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


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


def complaint(door, given, changed):
    """What is wrong with how a call ended; None for a result, or for an error as it has to be."""
    try:
        with no_hang(door.seconds):
            door.call(**given)
    except HangError:
        return "hangs"
    except AcceptedError:
        return None
    except OSError as error:
        return None if changed & {"path", "folder"} else f"bare {error!r:.200}"
    except Exception as error:
        message = str(error)
        if not isinstance(error, (ValueError, TypeError)) or not raised_by_switchfit(error):
            *_, place = traceback.extract_tb(error.__traceback__)
            return f"bare {type(error).__name__} at {place.filename}:{place.lineno}: {message[:200]}"
        words = {word for argument in changed for word in door.words.get(argument, (argument,))}
        if not any(word in message for word in words):
            return f"names none of {sorted(words)}: {message[:300]}"
        if not message.endswith("."):
            return f"is no sentence: {message[:300]}"
        if len(message) > LONGEST:
            return f"is {len(message)} characters long: {message[:300]}"
    return None


def calls_of(doors):
    """All ways to put one bad value into one argument: (door, argument, inside, bad value)."""
    return [
        (name, argument, inside, bad)
        for name, door in doors.items()
        for argument in door.valid
        for inside in ((False, True) if argument in door.inside or has_entries(door.valid[argument]) else (False,))
        for bad in BAD
    ]


def malformed(door, argument, inside, bad):
    value = BAD[bad]()
    if inside:
        own = door.inside.get(argument)
        value = put_inside(door.valid[argument], value) if own is None else own(value)
    return {argument: value}


def has_entries(value):
    return isinstance(value, (dict, list, tuple, np.ndarray)) and len(value) > 0


def put_inside(value, bad):
    """A valid value with a bad one in place of its first entry."""
    if isinstance(value, dict):
        return value | {next(iter(value)): bad}
    first, *others = value
    return [put_inside(first, bad) if isinstance(first, (list, np.ndarray)) else bad, *others]


def complaints(doors, calls):
    """What is wrong with the ends of all these calls, each of a door and one or two mistakes."""
    found = []
    for name, mistakes in calls:
        door = doors[name]
        changes: dict[str, Any] = {}
        for argument, inside, bad in mistakes:
            changes |= malformed(door, argument, inside, bad)
        wrong = complaint(door, door.valid | changes, set(changes))
        if wrong is not None:
            told = ", ".join(f"{argument} = {bad}{' inside' * inside}" for argument, inside, bad in mistakes)
            found.append(f"{name}({told}) {wrong}")
    return found


def pairs(doors, singles, rng, count):
    """Calls with two arguments changed, drawn at random."""
    by_door: dict[str, list[Any]] = {}
    for name, *mistake in singles:
        by_door.setdefault(name, []).append(tuple(mistake))
    several = [name for name, door in doors.items() if len(door.valid) > 1]
    drawn = []
    while len(drawn) < count:
        name = several[rng.integers(len(several))]
        one, two = (by_door[name][k] for k in rng.integers(len(by_door[name]), size=2))
        if one[0] != two[0]:
            drawn.append((name, (one, two)))
    return drawn


@pytest.fixture
def doors(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return catalogue()


OVERFLOWS = pytest.mark.filterwarnings("ignore:.*(overflow|invalid value|divide by zero):RuntimeWarning")
"""Near the largest double costs overflow: NumPy warns, the result is infinite and says so, and no call crashes."""
STUDIES = ("Fits.", "MonteCarlo.", "Multistart.", "Bootstrap.")


@pytest.fixture
def cheap_doors(doors, monkeypatch):
    monkeypatch.setattr("switchfit.batch.study.Batch.fit", take_long)
    monkeypatch.setattr(Evaluator, "constrained", take_long)
    monkeypatch.setattr("switchfit.uncertainty.certificate.measure_derivative_gap", take_long)
    return {name: door for name, door in doors.items() if not name.startswith(STUDIES)}


def test_the_doors_are_all_that_is_public(doors):
    """What is missing here is made by switchfit, not by users."""
    made_by_switchfit = {
        "ActiveConstraint", "Alarm", "Bootstrap", "Calibration", "Certificate", "ChannelResiduals", "Comparison",
        "DerivativeCheck", "Design", "Direction", "Estimate", "Evaluation", "Fits", "GuardedEvaluation",
        "Identifiability", "InputCorrelation", "Insertion", "Issue", "Kink", "Log", "LogPosterior", "ModeEnding",
        "ModeFit", "ModeSearch", "ModeStatus", "ModeWarning", "ModelComparison", "MonteCarlo", "Multistart", "Now",
        "OnlineLog", "OnlineStatus", "Prediction", "Profile", "ResidualDiagnostics", "SearchProgress", "Status",
        "Step", "Stiffness", "Termination", "Trajectory", "Validation", "Verdict",
    }  # fmt: skip
    assert set(sf.__all__) - made_by_switchfit <= set(doors)


@pytest.mark.fuzz
def test_the_valid_calls_succeed(doors):
    for name, door in doors.items():
        try:
            door.call(**door.valid)
        except Exception as error:
            raise AssertionError(f"{name}: {error}") from error


@OVERFLOWS
def test_some_malformed_calls(cheap_doors):
    rng = np.random.default_rng(12)
    singles = calls_of(cheap_doors)
    some = [singles[k] for k in rng.choice(len(singles), 600, replace=False)]
    calls = [(name, (tuple(mistake),)) for name, *mistake in some] + pairs(cheap_doors, singles, rng, 200)
    assert complaints(cheap_doors, calls) == []


@OVERFLOWS
@pytest.mark.fuzz
def test_every_malformed_call(doors):
    rng = np.random.default_rng(2024)
    singles = calls_of(doors)
    calls = [(name, (tuple(mistake),)) for name, *mistake in singles] + pairs(doors, singles, rng, 2000)
    assert len(calls) > 6500
    assert complaints(doors, calls) == []
