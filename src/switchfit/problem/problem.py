"""Problem: a system, the experiments made with it, and the parameters to estimate.

A problem does not change once it is built. What follows from its arguments is found in this order, each from those
before it:

1. the arguments, checked: alone (`validation`), then against one another (`consistency`);
2. `unknowns`: where each unknown stands in theta, with bounds, priors and the order of times;
3. `structures`, one for each experiment: its functions, traced. A structure and the lengths of arrays decide which
   compiled program is used;
4. cached properties (`durations`, `constraints`, `places`, `alike`, ...), found when they are first asked for. None
   depends on theta; methods that do (`vectors`, `split`, `check_theta`, ...) take it and cache nothing.

So nothing that is cached can be stale: other data (`dataclasses.replace`) or other sequences (`with_sequences`) are
another problem. The latter shares `_sources` with its origin, the functions that were traced; the former traces anew,
or finds its traces by their content (`functions`).

Other rooms keep with a problem what they find once for it, by `keep_with_problem`: its evaluator, its runs, the
comparisons in its functions. That too lives as long as the problem, and does not travel: pickles, copies and
`with_sequences` begin without it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, wraps
from itertools import pairwise, repeat
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from switchfit.arrays import BoolArray, Converted, FloatArray, IntArray
from switchfit.optimize import LinearConstraints
from switchfit.problem.consistency import check_durations, check_names, check_parameters
from switchfit.problem.constraints import Constraint, ConstraintKind
from switchfit.problem.costs import TerminalConstraint
from switchfit.problem.experiment import Experiment, drop_jumps, insert_jumps, name_runs, prefix_runs
from switchfit.problem.measurements import Measurements
from switchfit.problem.padding import choose_common_lengths
from switchfit.problem.structure import Structure
from switchfit.problem.system import HybridSystem
from switchfit.problem.tracing import Sources, trace_structure
from switchfit.problem.unknowns import Unknowns, list_unknowns
from switchfit.problem.validation.arrays import as_array, as_count, as_positive
from switchfit.problem.validation.messages import join_names, shorten, unit_suffix
from switchfit.problem.validation.names import as_choice, require_known
from switchfit.problem.validation.objects import as_instance, as_instances, set_fields
from switchfit.runtime.presentation import format_count, format_html, format_line, join_first

T = TypeVar("T")

PROBLEM_ARGUMENTS = (
    "system",
    "experiments",
    "parameters",
    "min_duration",
    "solver",
    "rtol",
    "atol",
    "engine",
    "max_transitions",
)
"""What a `Problem` is built from."""

SMALLEST_RTOL = 1e-13
"""Local errors below this part of the state are rounding."""

PERFECT_RESIDUAL = 1e-8
"""Residual of a perfect fit, as a part of the sample."""

DISORDER_BY_ROUNDING = 1e-12
"""Transition times that are out of order by less than this part of the horizon are so by rounding."""


@dataclass(frozen=True, eq=False)
class Problem:
    """A system, the experiments made with it, and the parameters to estimate.

    Parameters
    ----------
    system : HybridSystem
    experiments : Experiment or list of Experiment
        Parameters are shared by all of them, unless their `parameter_map` says otherwise; each has its own transition
        times, and its own initial state where that is unknown.
    parameters : mapping of str to Parameter, number or array
        A bare number is a free parameter without bounds.
    min_duration : float or mapping of str to float, optional
        Shortest time a mode may last, in the time unit that all experiments then share; 0 lets a mode vanish, which
        the result then reports. A mapping has it for each mode that it names, and 0 for the others.
    solver : {"auto", "explicit", "stiff"}, optional
        The steps of the integrator: Butcher's explicit Runge-Kutta method of order 5, or implicit ones, Radau IIA of
        order 5, for stiff modes. "auto" takes explicit steps in a mode unless they are hopeless there: limited by
        stability, a thousand or more, and implicit steps are at least five times fewer. This is decided whenever a mesh
        is made, at the guess and where a fit refines it. `Evaluation.stiffness`, `Estimate.engine`, the report and the
        log name the modes that take implicit steps. "explicit" and "stiff" are for all modes.
    rtol, atol : float, optional
        Tolerances of the local error by which the mesh is refined. With the defaults J has a relative error of about
        1e-8, its gradient and its Hessian of about 1e-7. Ten times smaller tolerances make these errors about ten times
        smaller or better, and take up to 1.6 times as many steps.

    engine : {"auto", "native", "jax"}, optional
        What evaluates the cost and its derivatives: machine code wherever the model has it and JAX otherwise; machine
        code, with an error that gives the reason where the model cannot be compiled; or JAX.
    max_transitions : int, optional
        Compile machine code for every sequence of the system's modes with up to so many transitions, so that problems
        with other sequences, but the same functions, data and `max_transitions`, need no compilation of their own.
        Left out, for the transitions and modes of the mode sequences. Jumps count as transitions. With 1 or more the
        problem may have nothing to estimate, such as a single mode from which a search for the sequence begins.

    Raises
    ------
    ValueError
        For unknown modes, unknown parameters in a map, impossible minimum durations, a minimum duration or a delay for
        experiments with different time units, or a vector field, reset map, observation or cost of the wrong shape or
        dtype.
    TypeError
        If an argument is of the wrong type.

    See Also
    --------
    HybridSystem, Experiment, Parameter : its parts.
    estimate, simulate, evaluate

    Examples
    --------
    A heater that is switched off at an unknown time; what it loses to the room is unknown too:

    >>> system = sf.HybridSystem(
    ...     {"on": lambda t, x, p: 10.0 - p["k"] * x, "off": lambda t, x, p: -p["k"] * x}, [0.0]
    ... )
    >>> log = sf.Measurements([1.0, 2.0, 3.0, 4.0], [8.2, 13.8, 12.9, 8.7], sigma=0.2)
    >>> run = sf.Experiment(log, ("on", "off"), (2.0,), 0.0, 4.0)
    >>> problem = sf.Problem(system, run, {"k": sf.Parameter(0.5, lower=0.0)})
    >>> problem.theta_names
    ('tau_1', 'k')
    >>> problem.initial_theta
    array([2. , 0.5])
    """

    system: HybridSystem
    experiments: Converted  # a tuple of `Experiment`
    parameters: Mapping[str, Converted] = field(default_factory=dict)
    min_duration: float | Mapping[str, float] = 0.0
    solver: Literal["auto", "explicit", "stiff"] = "auto"
    rtol: float = 1e-8
    atol: float = 1e-10
    engine: Literal["auto", "native", "jax"] = "auto"
    max_transitions: int | None = None
    unknowns: Unknowns = field(init=False)
    structures: tuple[Structure, ...] = field(init=False)

    def __repr__(self) -> str:
        runs, unknowns = format_count(len(self.experiments), "experiment"), join_first(self.theta_names) or "none"
        return format_line(self, runs, f"unknowns {unknowns}")

    def __post_init__(self) -> None:
        as_instance(self.system, "system", HybridSystem, "an sf.HybridSystem")
        experiments = as_instances(self.experiments, "experiments", Experiment, "an sf.Experiment")
        if not experiments:
            raise ValueError("experiments is empty: a problem needs at least one sf.Experiment.")
        set_fields(
            self,
            parameters=check_parameters(self.parameters),
            min_duration=check_durations(self.min_duration, self.system),
            solver=as_choice(self.solver, "solver", ("auto", "explicit", "stiff")),
            rtol=as_positive(self.rtol, "rtol"),
            atol=as_positive(self.atol, "atol"),
            engine=as_choice(self.engine, "engine", ("auto", "native", "jax")),
            max_transitions=None if self.max_transitions is None else as_count(self.max_transitions, "max_transitions"),
        )
        if not SMALLEST_RTOL <= self.rtol < 1:
            raise ValueError(f"rtol must lie between {SMALLEST_RTOL} (rounding) and 1; got {self.rtol}.")
        # The arguments against one another, before anything is traced: tracing may take seconds, and its messages are
        # about functions.
        for run in experiments:
            check_names(run, self.parameters)
        states = [self.system.initial_state, *(run.initial_state for run in experiments)]
        sizes = {len(state) for state in states if state is not None and not callable(state)}
        if len(sizes) > 1:
            raise ValueError(f"initial_state must have as many entries in the system and all experiments; got {sizes}.")
        self._set_experiments(experiments)
        # An initial state that is a function of p has a length only now that it is traced.
        for structure in self.structures:
            self.system._check_labels_of(structure.n)
        if not self.max_transitions:
            require_unknowns(self)
        self._check_noise()

    def _set_experiments(self, experiments: tuple[Experiment, ...]) -> None:
        """Set the experiments, the unknowns and the structures, once all else is set."""
        most = self.max_transitions
        for run in experiments:
            require_known(run.mode_sequence, "mode_sequence", self.system.modes)
            transitions = len(run.transition_times) + len(run.jump_times)
            if most is not None and most < transitions:
                raise ValueError(f"max_transitions is {most}, but a mode_sequence has {transitions} transitions.")
        unknowns = list_unknowns(self.system, experiments, self.parameters, self.durations)
        # Two steps: tracing reads `_sources`, a cached property, and nothing of it depends on experiments.
        set_fields(self, experiments=experiments, unknowns=unknowns)
        set_fields(self, structures=tuple(trace_structure(self._sources, run, most) for run in experiments))

    def _check_noise(self) -> None:
        """Raise ValueError if something is weighed against noise that is unknown."""
        # Without sigma J is a sum of squares in the unit of the data, whose minimum is that of the likelihood. A sum of
        # it and a term without unit, such as a prior, has a minimum that depends on the unit.
        relative = self.unknowns.priors.any or not self.is_least_squares
        if relative and any(item.sigma is None for item in self.measurements):
            raise ValueError(
                "sigma is left out in some Measurements, and something is weighed against the noise: a prior, a robust "
                "loss, or other Measurements whose sigma is a parameter. Give sigma a number there, or the name of a "
                "parameter to estimate it."
            )

    @cached_property
    def _sources(self) -> Sources:
        """What structures are traced from, with the functions that were traced; other sequences share it.

        A search of the mode sequence makes hundreds of problems of one: each function is then traced once.
        """
        return Sources(self.system, self.parameters, self.solver, {})

    def with_sequences(self, sequences: Sequence[Sequence[str]], transition_times: Sequence[ArrayLike]) -> Problem:
        """Return the problem with other mode sequences, which takes a fraction of the time of building it anew.

        Its transition times are free, whatever those of this problem are. If `max_transitions` is set, it compiles
        nothing.

        Parameters
        ----------
        sequences : sequence of sequences of str, one for each experiment
        transition_times : sequence of (N,) array_like, one for each experiment
            Guesses.

        Raises
        ------
        ValueError
            If sequences and times do not match, or the sequences are not of this problem's modes and length.

        See Also
        --------
        HybridSystem, Experiment

        Examples
        --------
        >>> problem = heater_problem()

        >>> problem.with_sequences([("off", "on", "off")], [(1.0, 3.0)]).theta_names
        ('tau_1', 'tau_2', 'k')
        """
        counts = [len(each) for each in (self.experiments, sequences, transition_times)]
        if len(set(counts)) > 1:
            raise ValueError(f"each experiment needs a sequence and its times; got {counts} of them.")
        given = zip(self.experiments, sequences, transition_times, strict=True)
        experiments = tuple(
            replace(run, mode_sequence=tuple(modes), transition_times=tuple(np.asarray(times, dtype=float).tolist()))
            for run, modes, times in given
        )
        # Without `__post_init__`: the arguments were checked when this problem was built, and only the experiments
        # differ.
        changed: Problem = object.__new__(Problem)
        set_fields(changed, **{name: getattr(self, name) for name in (*PROBLEM_ARGUMENTS, "_sources")})
        changed._set_experiments(experiments)
        return changed

    def __getstate__(self) -> dict[str, object]:
        """What is pickled: the user's functions, and of their traces what identifies them."""
        return {name: getattr(self, name) for name in PROBLEM_ARGUMENTS} | {"digests": self.digests}

    @property
    def digests(self) -> list[dict[str, str]]:
        """What identifies the functions of each experiment in every process."""
        return [structure.digests for structure in self.structures]

    def __setstate__(self, state: dict[str, Converted]) -> None:
        """Build the problem again; ValueError if a function does something else than when the problem was built."""
        # Functions are traced anew in this process. A function of a module is pickled by its name alone: if the file
        # has changed since, or a global that it reads, a worker would fit another model without this comparison.
        set_fields(self, **{name: state[name] for name in PROBLEM_ARGUMENTS})
        self.__post_init__()
        for structure, digests in zip(self.structures, state["digests"], strict=True):
            changed = [name for name, digest in structure.digests.items() if digests.get(name) != digest]
            if changed:
                raise ValueError(
                    f"{', '.join(changed)} does something else in this process than when the problem was built: what "
                    "it reads has changed. Build the problem anew before it is sent to other processes."
                )

    @cached_property
    def durations(self) -> dict[str, float]:
        """The shortest time each mode of the system may last: `min_duration`, 0 for a mode that it leaves out."""
        given = self.min_duration
        return {mode: given.get(mode, 0.0) if isinstance(given, Mapping) else given for mode in self.system.modes}

    @property
    def measurements(self) -> tuple[Measurements, ...]:
        """The `Measurements` of all experiments, in their order."""
        return tuple(item for experiment in self.experiments for item in experiment.measurements)

    @property
    def initial_theta(self) -> FloatArray:
        """The first guess of everything estimated: a ``(d,)`` array."""
        return self.unknowns.initial.copy()

    @property
    def theta_names(self) -> tuple[str, ...]:
        """Name of each entry of theta, transition times first, "tf" behind them where it is free."""
        return self.unknowns.names

    @cached_property
    def constraint_names(self) -> tuple[str, ...]:
        """What has to be zero: guards at transitions, then terminal constraints, experiment by experiment."""
        names = []
        for prefix, structure, experiment in zip(
            prefix_runs(self.experiments), self.structures, self.experiments, strict=True
        ):
            # of the user's transitions: those of the structure have the jumps in between
            pairs = zip(pairwise(experiment.mode_sequence), drop_jumps(experiment, structure.guards), strict=False)
            names += [f"{prefix}guard of tau_{i} ({a} -> {b})" for i, ((a, b), guard) in enumerate(pairs, 1) if guard]
            names += [f"{prefix}terminal constraint {k + 1}" for k in range(structure.terminal_constraint_count)]
        return tuple(names)

    @cached_property
    def constraint_counts(self) -> tuple[int, ...]:
        """Number of constraints of each experiment."""
        return tuple(len(s.guarded) + s.terminal_constraint_count for s in self.structures)

    @cached_property
    def run_names(self) -> tuple[str, ...]:
        """What each experiment is called: its name, or run1, run2, ..."""
        return name_runs(self.experiments)

    @cached_property
    def constraints(self) -> LinearConstraints:
        """The order and durations of modes, then all lower and all upper bounds, infinite ones included."""
        unknowns = self.unknowns
        runs = zip(self.experiments, unknowns.times, strict=True)
        jumps = {(i, t) for run, times in runs for i in times.tolist() for t in run.jump_times.tolist() if t > run.t0}

        # A bound at the time of a `Jump` is not one that the user gave (`Experiment.times`): messages say so.
        def name_bounds(kind: ConstraintKind, values: FloatArray) -> list[Constraint]:
            each = enumerate(zip(values.tolist(), unknowns.names, strict=True))
            return [Constraint("known jump" if (i, v) in jumps else kind, v, name) for i, (v, name) in each]

        lower, upper = name_bounds("lower bound", unknowns.lower), name_bounds("upper bound", unknowns.upper)
        names = (*unknowns.rows, *lower, *upper)
        return LinearConstraints(unknowns.A, unknowns.b, unknowns.lower, unknowns.upper, names)

    @cached_property
    def is_least_squares(self) -> bool:
        """Whether J is half a sum of squares: no loss is robust, no sigma a parameter."""
        return not any(item.sigma_names or item.loss != "linear" for item in self.measurements)

    @cached_property
    def is_sigma(self) -> BoolArray:
        """Which unknowns are the sigma of Measurements: (d,)."""
        given = [(run, name) for run in self.experiments for item in run.measurements for name in item.sigma_names]
        return np.isin(self.theta_names, [run.parameter_map.get(name, name) for run, name in given if name])

    @property
    def estimates_delays(self) -> bool:
        """Whether the delay of any Measurements is a parameter."""
        return any(isinstance(item.delay, str) for item in self.measurements)

    @property
    def has_plain_samples(self) -> bool:
        """Whether no sigma and no delay is a parameter, and no unknown has a prior; losses may be robust."""
        named = any(item.sigma_names for item in self.measurements)
        return not named and not self.unknowns.priors.any and not self.estimates_delays

    @cached_property
    def is_sigma_known(self) -> bool | None:
        """Whether sigma is given for all measurements, as a number or as a parameter.

        None if the cost has other terms than measurements and terminal constraints.
        """
        items = [item for run in self.experiments for item in run.data if not isinstance(item, TerminalConstraint)]
        if not items or not all(isinstance(item, Measurements) for item in items):
            return None
        return all(item.sigma is not None for item in items)

    @cached_property
    def smallest_cost(self) -> float:
        """The cost below which errors are not measured relative to the cost itself.

        For half a sum of squares it is the cost of a perfect fit, with residuals of 1e-8 of the samples. A negative log
        likelihood may have any value, 0 too; its terms are of the size of half the number of samples.
        """
        if not self.is_least_squares:
            return 0.5 * sum(item.count for item in self.measurements)
        # 1e-300: data that are all zero have no size, and divisions by this cost have to be possible.
        squares = sum(float(np.nansum(item.weights * item.values**2)) for item in self.measurements)
        return max(0.5 * PERFECT_RESIDUAL**2 * squares, 1e-300)

    @cached_property
    def places(self) -> tuple[IntArray, ...]:
        """For each experiment the positions in theta of its N transition times and of its p (M,), -1 where fixed.

        Jumps are among the N, as transitions at fixed times.
        """
        runs = enumerate(zip(self.experiments, self.unknowns.times, self.structures, strict=True))
        found = []
        for e, (run, times, structure) in runs:
            p = self.unknowns.place(e, structure.parameters, run.parameter_map)
            found.append(np.concatenate([insert_jumps(run, times, repeat(-1)), p]).astype(np.intp))
        return tuple(found)

    @cached_property
    def own_places(self) -> list[tuple[IntArray, IntArray]]:
        """For each experiment which entries of what its programs take are unknowns, and their positions in theta."""
        return [(own, places[own]) for places in self.places for own in [np.flatnonzero(places >= 0)]]

    @cached_property
    def one_to_one(self) -> bool:
        """Whether theta is what the programs of a single experiment take."""
        return len(self.places) == 1 and np.array_equal(self.places[0], np.arange(len(self.theta_names)))

    @cached_property
    def sizes(self) -> FloatArray:
        """Typical size of each unknown, by which rounding is measured: (d,).

        For a transition time it is the length of the horizon, or what the clock reads if that is more: a time that is
        1e-30 after t0 = 0 is t0.
        """
        return self.unknowns.put_at_times(np.abs(self.unknowns.initial), [run.clock for run in self.experiments])

    def vectors(self, theta: FloatArray, e: int) -> tuple[FloatArray, FloatArray]:
        """Return what the compiled programs of experiment e take: its times (N,), jumps among them and a free tf last,
        and its p (M,).

        See Also
        --------
        Problem.split

        Examples
        --------
        >>> problem = heater_problem()

        >>> problem.vectors(problem.initial_theta, 0)
        (array([2.]), array([0.5]))
        """
        places, N = self.places[e], self.structures[e].N
        if self.one_to_one:  # the common case, at every step of the optimizer: views, no copies
            return theta[:N], theta[N:]
        tau, where = self.experiments[e].initial_times_with_jumps.copy(), places[:N]
        tau[where >= 0] = theta[where[where >= 0]]
        return tau, theta[places[N:]]

    @cached_property
    def alike(self) -> tuple[tuple[int, ...], ...]:
        """Groups of experiments (from 0) that have equal structures: one program each, if their lengths agree too."""
        groups: dict[Structure, list[int]] = {}
        for e, structure in enumerate(self.structures):
            groups.setdefault(structure, []).append(e)
        return tuple(tuple(group) for group in groups.values())

    @cached_property
    def sample_lengths(self) -> tuple[tuple[int, ...], ...]:
        """For each experiment the lengths to which the samples of each of its Measurements are padded."""
        # 1 at least: an `OnlineEstimator` starts with no samples, and programs take one of weight 0.
        counts = [[max(len(item.times), 1) for item in e.measurements] for e in self.experiments]
        for group in self.alike:
            for k in range(len(counts[group[0]])):
                for e, length in zip(group, choose_common_lengths([counts[e][k] for e in group]), strict=True):
                    counts[e][k] = length
        return tuple(tuple(lengths) for lengths in counts)

    def _repr_html_(self) -> str:
        return format_html(self)

    def name_parameters(self, theta: FloatArray, e: int) -> dict[str, FloatArray]:
        """Return the parameters of experiment e under the names that the model has for them.

        See Also
        --------
        Problem.split

        Examples
        --------
        >>> problem = heater_problem()

        >>> float(problem.name_parameters(problem.initial_theta, 0)["k"])
        0.5
        """
        own = self._split_parameters(theta)
        mapped = self.experiments[e].parameter_map
        return own | {name: own[target] for name, target in mapped.items()}

    def late_times(self, theta: FloatArray, e: int) -> FloatArray:
        """Return the times of the states that late samples of experiment e saw, if their delay is a parameter: (K,).

        See Also
        --------
        Measurements

        Examples
        --------
        >>> problem = heater_problem()

        >>> problem.late_times(problem.initial_theta, 0)
        array([], dtype=float64)
        """
        late = [item for item in self.experiments[e].measurements if isinstance(item.delay, str)]
        named = self.name_parameters(theta, e) if late else {}
        return np.concatenate([np.zeros(0), *(item.times - named[item.delay] for item in late)])

    def check_theta(self, theta: ArrayLike | None, what: str = "theta") -> FloatArray:
        """Return `theta`, or the initial guess for None, as a ``(d,)`` array; messages call it `what`.

        Raises
        ------
        ValueError
            Where the shape is wrong, or the order of transition times and known jumps.

        See Also
        --------
        simulate, evaluate

        Examples
        --------
        >>> problem = heater_problem()

        >>> problem.check_theta(None)
        array([2. , 0.5])
        """
        if theta is None:
            return self.initial_theta
        checked = as_array(theta, what, finite=True)
        if checked.shape != self.unknowns.initial.shape:
            raise ValueError(
                f"{what} must have shape ({len(self.theta_names)},): {join_names(self.theta_names)}; "
                f"got shape {checked.shape}."
            )
        for e, (experiment, where) in enumerate(zip(self.experiments, self.unknowns.times, strict=True)):
            # The order of times. A step of the optimizer onto a constraint may miss it by rounding, which is mended
            # here, since rows of negative length have no meaning; more than rounding is a mistake of the caller.
            times = self._select_times(checked, e)
            knots = np.concatenate([[experiment.t0], times, [experiment.end]])
            shortest = (knots[1:] - knots[:-1]).min()
            if shortest < -DISORDER_BY_ROUNDING * experiment.clock:
                last = ", with the upper bound of tf for its end" if experiment.has_free_tf else ""
                raise ValueError(
                    f"The transition times in {what} must not decrease inside (t0, tf) = ({experiment.t0}, "
                    f"{experiment.end}){last}; got {shorten(times)}."
                )
            if shortest < 0:  # by rounding: put in order, round the times that are fixed
                # Free times between the fixed ones before and after them, which stay as they are.
                low = np.maximum.accumulate(np.append(experiment.t0, np.where(where < 0, times, -np.inf)))[1:]
                high = np.minimum.accumulate(np.append(np.where(where < 0, times, np.inf), experiment.end)[::-1])[::-1]
                ordered = np.maximum.accumulate(np.clip(times, low, high[:-1]))
                checked[where[where >= 0]] = ordered[where >= 0]
            # Known jumps: each stays between the transitions between which it was at the guess, as the order of
            # segments is part of the structure.
            for jump, n in zip(experiment.jump_times.tolist(), experiment.passed_by_jumps.tolist(), strict=True):
                if (
                    knots[n] > jump + DISORDER_BY_ROUNDING * experiment.clock
                    or knots[n + 1] < jump - DISORDER_BY_ROUNDING * experiment.clock
                ):
                    raise ValueError(
                        f"The transition times in {what} must stay on that side of each known jump on which their "
                        f"guesses are; got {shorten(times)}, on another side of the jump at {jump:g}. Give the "
                        "Experiment transition_times on that side."
                    )
            # Late samples: the states that they saw must lie on the trajectory.
            seen = self.late_times(checked, e)
            if seen.size and (seen.min() < experiment.t0 or seen.max() > experiment.earliest_end):
                raise ValueError(
                    f"{what} has delays with which samples are of moments from {seen.min():.6g} to {seen.max():.6g}"
                    f"{unit_suffix(experiment.time_unit)}, outside ({experiment.t0}, {experiment.earliest_end})."
                )
        return checked

    def ends_of_modes(self, theta: FloatArray) -> list[FloatArray]:
        """Return when each mode begins and the last one ends, at tf, for theta (..., d): an array (..., one more than
        modes) for each experiment.

        See Also
        --------
        Problem.split

        Examples
        --------
        >>> problem = heater_problem()

        >>> problem.ends_of_modes(problem.initial_theta)
        [array([0., 2., 6.])]
        """
        return [run.ends_of_modes(self._select_times(theta, e)) for e, run in enumerate(self.experiments)]

    def _select_times(self, theta: FloatArray, e: int) -> FloatArray:
        """Return all times of experiment e, fixed ones and a free tf included, for theta (..., d): (..., N)."""
        where = self.unknowns.times[e]
        times = np.broadcast_to(self.experiments[e].initial_times, (*theta.shape[:-1], len(where))).copy()
        times[..., where >= 0] = theta[..., where[where >= 0]]
        return times

    def split(self, theta: FloatArray) -> tuple[list[FloatArray], dict[str, FloatArray]]:
        """Return all transition times, one ``(N,)`` array an experiment, and all parameters by name, fixed ones
        included.

        See Also
        --------
        Problem.name_parameters

        Examples
        --------
        >>> problem = heater_problem()

        >>> times, parameters = problem.split(problem.initial_theta)
        >>> times, float(parameters["k"])
        ([array([2.])], 0.5)
        """
        return [ends[1:-1] for ends in self.ends_of_modes(theta)], self._split_parameters(theta)

    def _split_parameters(self, theta: FloatArray) -> dict[str, FloatArray]:
        """Return all parameters by name, fixed ones included."""
        spans = self.unknowns.parameters
        return {
            name: theta[spans[name]].reshape(q.shape) if name in spans else q.value
            for name, q in self.parameters.items()
        }


def keep_with_problem(build: Callable[[Problem], T]) -> Callable[[Problem], T]:
    """Let a function of a problem be called once for each problem, which keeps what it returned.

    For what is found of a problem in a room above this one, where it cannot be a cached property. It is dropped with
    the problem: there is no table of problems that would keep them, their data and their evaluators alive. It must
    follow from the problem alone, since nothing asks for it anew.
    """

    @wraps(build)
    def find(problem: Problem) -> T:
        # The key is the function's name, so that a profile or a debugger shows what a problem holds: no two functions
        # may share one, nor have that of an attribute of `Problem`. Two threads may both build it; the last one stays.
        if build.__name__ not in problem.__dict__:
            problem.__dict__[build.__name__] = build(problem)
        kept: T = problem.__dict__[build.__name__]
        return kept

    return find


def require_estimable(problem: Problem) -> None:
    """Raise ValueError if a problem has no unknowns, or a sensor no samples."""
    require_unknowns(problem)
    require_samples(problem)


def check_start(problem: Problem, start: ArrayLike | None) -> FloatArray:
    """Return where a fit begins, (d,): a start in the order of theta, or the initial guess for None.

    Raises
    ------
    ValueError
        As `Problem.check_theta` does, and where an unknown on a logarithmic scale is not above 0.
    """
    first, unknowns = problem.check_theta(start, "start"), problem.unknowns
    if names := [unknowns.names[i] for i in np.flatnonzero(unknowns.log & ~unknowns.is_time & (first <= 0))]:
        raise ValueError(f"start must be above 0 for {join_names(names)}, whose scale is 'log'; got {shorten(first)}.")
    return first


def require_samples(problem: Problem) -> None:
    """Raise ValueError if a sensor has no samples, as it may for an `OnlineEstimator`."""
    for name, run in zip(problem.run_names, problem.experiments, strict=True):
        if not all(len(item.times) for item in run.measurements):
            raise ValueError(f"the Measurements of {name} have no samples: give times and values.")


def require_unknowns(problem: Problem) -> None:
    """Raise ValueError if a problem has no unknowns, as one with `max_transitions` may."""
    if not problem.theta_names:
        raise ValueError(
            "Nothing to estimate: every parameter and transition time is fixed. If the mode sequence is what you look "
            "for, set max_transitions of the Problem to the largest number of switches, and use sf.insertion."
        )
