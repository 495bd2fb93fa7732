"""The keys of problem files: each table is a model of `pydantic`, each key a field.

The text below a field describes it in error messages and in the tables of ``docs/problem-file.md``.
"""

from __future__ import annotations

import ast
import datetime
import inspect
import math
from itertools import pairwise
from typing import Annotated, Any, Literal, TypeVar

import pydantic
from pydantic import BeforeValidator, Field, Tag
from pydantic_core import PydanticCustomError

OPTIONS = {"strategy", "time_budget", "hessian", "tolerance", "max_iterations"}
"""Options of `estimate`."""

HessianKind = Literal["auto", "exact", "descent-first", "block-diagonal", "gauss-newton", "none"]

ENTRY = BeforeValidator(lambda given: given if isinstance(given, list) else [given])
"""A list; a single entry becomes a list of one."""

Other = TypeVar("Other")
Entries = TypeVar("Entries")

OrTable = Annotated[
    Annotated[Other, Tag("other")] | Annotated[dict[str, Entries], Tag("table")],
    pydantic.Discriminator(lambda given: "table" if isinstance(given, dict) else "other"),
]
"""Something, or a table with entries; errors are about what is given, and not about either."""

Positive = Annotated[float, Field(gt=0)]
Duration = Annotated[float, Field(ge=0)]
Names = Annotated[list[str], Field(min_length=1)]
NameOrNames = Annotated[list[str], ENTRY]

MinDuration = OrTable[Duration, Duration]
"""One for all modes, or one for each; 0 for those that are left out."""


class TomlTable(pydantic.BaseModel):
    """A table of a problem file, without other keys than its fields."""

    model_config = pydantic.ConfigDict(extra="forbid", strict=True, frozen=True, defer_build=True)


def describe_keys(kind: type[TomlTable]) -> dict[str, str]:
    """Return the text below each key of a table, in one line.

    It is read from the source when it is needed. pydantic would read it for all tables when they are defined
    (``use_attribute_docstrings``), which takes a tenth of the time until an unknown key is named.

    Parameters
    ----------
    kind : type
    """
    found: dict[str, str] = {}
    # Base classes first, so that a table's own text of a key replaces the inherited one.
    for each in reversed(kind.__mro__[: kind.__mro__.index(TomlTable)]):
        (definition,) = ast.parse(inspect.getsource(each)).body
        # A string expression right behind an annotated name is that key's text.
        for key, text in pairwise(ast.iter_child_nodes(definition)):
            if isinstance(key, ast.AnnAssign) and isinstance(text, ast.Expr):
                found[ast.unparse(key.target)] = " ".join(ast.literal_eval(text.value).split())
    return found


def is_date(given: object) -> bool:
    """Return whether a value is a date: one of TOML's own, or text in ISO 8601.

    Parameters
    ----------
    given : object
    """
    if not isinstance(given, str):
        return isinstance(given, datetime.date)
    # Here, since NumPy takes a third of the time until a mistake is named.
    from switchfit.problem.dates import read_date_text

    return read_date_text(given) is not None


def _check_time(given: object) -> object:
    """Return a number or a date."""
    # A bool is an int of Python, but true is no time.
    if isinstance(given, (int, float)) and not isinstance(given, bool):
        return float(given)
    if is_date(given):
        return given
    from switchfit.problem.dates import DATE_EXAMPLES as EXAMPLES

    raise PydanticCustomError("time_type", f"Input should be a number or a date such as {EXAMPLES}")


def _wrap(key: str, **more: object) -> BeforeValidator:
    """Return a validator that makes a table with one key, and more, of anything that is no table."""
    return BeforeValidator(lambda given: given if isinstance(given, dict) else {key: given, **more})


GUESS = _wrap("value")
"""``0.8``, the guess of an unknown, becomes ``{ value = 0.8 }``."""


KNOWN_VALUE = _wrap("value", fixed=True)
"""``0.5``, a state at t0 or tf, becomes ``{ value = 0.5, fixed = true }``."""


NAMED_OBJECT = _wrap("name")
"""``"skid_steer"``, a model without arguments, becomes ``{ name = "skid_steer" }``."""


Time = Annotated[Any, pydantic.PlainValidator(_check_time)]
"""A number in the experiment's time unit, or a date."""


class PriorTable(TomlTable):
    """A prior: normal with mean and sd, or log-normal with median and log_sd."""

    mean: Time = None
    """mean of a normal prior"""
    sd: float | None = None
    """standard deviation of a normal prior"""
    median: float | None = None
    """median of a log-normal prior"""
    log_sd: float | None = None
    """standard deviation of the logarithm, for a log-normal prior"""


class ParameterTable(TomlTable):
    """A guess with bounds, unit and prior; a bare number is a guess without bounds."""

    value: float | list[float]
    """first guess, or the value itself where fixed"""
    lower: float = -math.inf
    """lower bound"""
    upper: float = math.inf
    """upper bound"""
    unit: str = ""
    """unit, for the report"""
    fixed: bool = False
    """true if it is known and not to be estimated"""
    prior: PriorTable | None = None
    """what is known of it: { mean = 0.8, sd = 0.1 } (normal) or { median = 0.8, log_sd = 0.1 } (log-normal)"""
    scale: Literal["linear", "log"] = "linear"
    """'log': estimated as its logarithm"""


class TransitionTable(ParameterTable):
    """First guess of a transition time, or of tf, with bounds."""

    value: Time
    """first guess of the transition time, in the experiment's time_unit, or a date"""
    lower: Time = -math.inf
    """earliest time"""
    upper: Time = math.inf
    """latest time"""


class StateTable(ParameterTable):
    """An entry of the initial state: a guess, or a known value."""

    value: float
    """first guess of the state at t0, or the value itself where fixed"""
    unit: str = ""
    """unit, for the report; left out, that of the state"""


class LogTable(TomlTable):
    """Channels of a log over time."""

    file: str | None = None
    """the log, relative to the problem file; a pattern such as 'logs/*.csv' or a folder stands for one run a log; left
    out, a log given to switchfit fit --problem, or what comes through switchfit online --stdin"""
    time: str | None = None
    """name of the column with the time; left out, it is found"""
    topic: str | None = None
    """topic of a ROS bag, or struct of a .mat file"""
    origin: Annotated[list[float], Field(min_length=2, max_length=3)] | None = None
    """[latitude, longitude] or [latitude, longitude, altitude] of the origin of east, north and up; left out, the first
    position"""
    range_error: Positive | None = None
    """standard deviation of the distance to a satellite in m; HDOP times it is sigma"""
    epoch: Literal["s", "ms", "us", "ns"] | None = None
    """the numbers in the time column count from 1970 (UTC) in this unit: they are dates"""
    window: Annotated[list[Time], Field(min_length=2, max_length=2)] | None = None
    """[from, to]: only rows with the time column, or the date, in between are used"""
    time_offset: float | Literal["first"] = 0.0
    """subtracted from the time column; 'first': the time of the first row"""
    time_scale: Positive | None = None
    """then multiplied: 1e-3 turns ms into s; left out, 1"""
    repair: NameOrNames = []
    """what may be changed: 'sort', 'drop-duplicates', 'drop-missing-times', 'drop-broken-lines', 'unwrap:CHANNEL'"""


class DataTable(LogTable):
    """Data to which the model is fitted."""

    columns: Names
    """names of the columns with the values"""
    kind: Literal["measurements", "reference"] = "measurements"
    """discrete noisy samples, or a continuous reference signal"""
    observe: str | list[str] | None = None
    """the state that each column measures, by name, or 'file.py:function' with h(t, x, p); left out, the columns are
    the whole state"""
    sigma: float | str | list[float | str] | None = None
    """standard deviation of the noise: a number, one per column, the names of columns that hold it, or of parameters
    that it is; left out, it is unknown (measurements only)"""
    loss: Literal["linear", "soft_l1", "huber", "cauchy"] = "linear"
    """loss of the residuals, for outliers (measurements only)"""
    loss_scale: Positive = 1.0
    """residual, in sigmas, above which it counts as an outlier"""
    delay: float | str = 0.0
    """delay of the sensor, in the experiment's time_unit, or the name of the parameter that it is (measurements
    only)"""
    lowpass_hz: Positive | None = None
    """cut-off of a low-pass filter, in cycles per time_unit of the experiment: Hz if that is s (reference only)"""
    weights: list[float] | None = None
    """weight of each column (reference only)"""


class InputTable(LogTable):
    """A known input u(t); the modes are then functions f(t, x, p, u)."""

    columns: Annotated[OrTable[Names, str], Field(min_length=1)]
    """names of the columns with the values, or { name in the model = column }, with which u is a dict"""
    kind: Literal["hold", "linear", "cubic"] = "hold"
    """interpolation between samples"""


class ModelTable(TomlTable):
    """The model: built in, or in a Python file."""

    name: str
    """a built-in model, or 'file.py:object' with a HybridSystem or a function making one"""
    arguments: dict[str, Any] = {}
    """arguments of the function"""


class JumpTable(TomlTable):
    """A change of the state at known times."""

    time: Annotated[list[Time], ENTRY]
    """when, in the experiment's time_unit or as a date: one time, or several"""
    map: Annotated[ModelTable, NAMED_OBJECT]
    """'file.py:function' with map(t, x, p), which returns the state just after; or a table with the name and arguments
    of a function that returns such a map"""


class ExperimentTable(TomlTable):
    """One run."""

    mode_sequence: Names | None = None
    """names of the modes in the order of their activity; left out, switchfit modes finds it, for which there must be
    [library]"""
    transition_times: list[Annotated[TransitionTable, GUESS]] | None = None
    """first guess of each transition time, in time_unit or as a date, one fewer than modes; if left out, all of the log
    is searched"""
    time_unit: str = Field(default="s", min_length=1)
    """unit of all times of the run; dates are converted to it, numbers are not"""
    origin: Time = None
    """date at which times are 0; left out, t0 if it is a date, else the first date"""
    time_zone: str | None = None
    """zone of the dates that state none, and in which dates are shown, such as 'Europe/Berlin'"""
    data: Annotated[list[DataTable], Field(min_length=1), ENTRY]
    """data to which the model is fitted; the costs of several tables are added"""
    t0: Time = None
    """start of the horizon, a number or a date; left out, the first sample"""
    tf: Annotated[TransitionTable, KNOWN_VALUE] | None = None
    """end of the horizon; left out, the last sample. A number or a date, or a table with value, lower and upper if it
    is to be estimated"""
    initial_state: list[Annotated[StateTable, KNOWN_VALUE]] | None = None
    """state at t0, instead of the model's: a number, or a table if it is to be estimated"""
    parameter_map: dict[str, str] = {}
    """the model's name of a parameter = the name under [parameters] that this run uses for it"""
    inputs: InputTable | None = None
    """a known input"""
    jumps: Annotated[list[JumpTable], ENTRY] = []
    """tables with time and map: changes of the state at known times, such as doses"""
    name: str | None = None
    """used in the report if there are several experiments"""

    def list_logs(self) -> dict[str, DataTable | InputTable]:
        """Return the tables that name a log by their places: the data, then the inputs."""
        logs: dict[str, DataTable | InputTable] = {f"data[{k}]": item for k, item in enumerate(self.data, start=1)}
        return logs if self.inputs is None else logs | {"inputs": self.inputs}


class LibraryTable(TomlTable):
    """The mode sequences among which ``switchfit modes`` searches."""

    modes: Names | None = Field(default=None, serialization_alias="library")
    """names of the modes that may occur; left out, all of the model"""
    first: NameOrNames | None = None
    """mode or modes with which a sequence may begin; left out, any"""
    last: NameOrNames | None = None
    """mode or modes with which a sequence may end; left out, any"""
    min_duration: MinDuration | None = None
    """shortest time a mode may last, or a table with a time for each mode; left out, that of [options]"""
    successions: dict[str, NameOrNames] | None = None
    """mode = the modes that may follow it; a mode that is left out is the last; left out, any may follow any"""


class OnlineTable(TomlTable):
    """How ``switchfit online`` follows the samples, where its options leave it open."""

    window: Positive | None = None
    """how long samples are kept, in time_unit; left out, all are"""
    renews: dict[str, NameOrNames] | None = None
    """mode = the parameters that have a new value whenever it begins"""
    drift: dict[str, Positive] | None = None
    """parameter = the standard deviation of its random walk after one time_unit; it needs a window"""


class DesignTable(TomlTable):
    """What ``switchfit design`` may choose of the last run."""

    free: dict[str, Annotated[list[float | list[float]], Field(min_length=2, max_length=2)]] | None = None
    """entry of the input = [lower, upper] limits, numbers or a list with one for each row of the input's log; an input
    without names is u, or u[0], u[1], ..."""
    criterion: Literal["D", "A", "E"] | None = None
    """'D': determinant of the covariance, the default; 'A': its trace; 'E': its largest eigenvalue"""
    names: OrTable[NameOrNames, Positive] | None = None
    """unknowns that count, or a table with the scale of each; left out, all"""
    samples: OrTable[int, int] | None = None
    """most sample times of each sensor, or a table with a number for each; left out, all"""
    sensors: OrTable[int, Positive] | None = None
    """most sensors, or a table with the cost of each, which is called by its channels, such as 'X, Y'; left out, all"""
    budget: Positive | None = None
    """most that the sensors may cost together"""
    starts: int | None = Field(default=None, ge=0)
    """inputs at random from which the search begins; left out, 8"""


class OptionsTable(TomlTable):
    """Options of the fit; options that are left out have the library's defaults."""

    min_duration: MinDuration | None = None
    """shortest time a mode may last, in the time_unit of the experiments, or a table with a time for each mode"""
    solver: Literal["auto", "explicit", "stiff"] | None = None
    """steps of the integrator; 'stiff' takes implicit ones, 'auto' where they are needed"""
    rtol: Positive | None = None
    """relative tolerance of the integrator"""
    atol: Positive | None = None
    """absolute tolerance of the integrator"""
    strategy: Literal["local", "auto", "thorough"] | None = None
    """'local' is one fit, 'auto' more if its verdict is not good, 'thorough' all strategies"""
    time_budget: Positive | None = None
    """seconds after which strategies end"""
    hessian: HessianKind | None = None
    """quadratic term of the optimizer: 'auto' is the exact Hessian in a trust region, 'exact' that with a line search,
    'descent-first' steepest descent until it is positive definite, 'none' steepest descent"""
    tolerance: Positive | None = None
    """optimality at which to stop"""
    max_iterations: int | None = Field(default=None, ge=0)
    """most iterations"""


class Contents(TomlTable):
    """The whole file: a model with parameters and experiments, or a problem built in Python."""

    model: Annotated[ModelTable, NAMED_OBJECT] | None = None
    """a built-in model, or 'file.py:object', or a table with name and arguments"""
    problem: Annotated[ModelTable, NAMED_OBJECT] | None = None
    """'file.py:object' with an sf.Problem or a function making one, instead of all the rest"""
    parameters: dict[str, Annotated[ParameterTable, GUESS]] = {}
    """the model's parameters"""
    experiments: Annotated[list[ExperimentTable], ENTRY] = []
    """the runs"""
    library: LibraryTable | None = None
    """the mode sequences among which switchfit modes searches; empty, all"""
    online: OnlineTable = Field(default_factory=OnlineTable.model_construct)
    """how switchfit online follows the samples"""
    design: DesignTable | None = None
    """what switchfit design may choose"""
    options: OptionsTable = Field(default_factory=OptionsTable.model_construct)
    """how to solve"""
