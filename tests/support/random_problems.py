"""Random systems with everything that a problem may contain, and the same twice: for switchfit and in NumPy."""

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from itertools import compress, pairwise, product
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np

import switchfit as sf
from support import reference

RTOL, ATOL = 1e-11, 1e-12
"""Tolerances of the meshes: integration errors are then below the tolerances of the comparison."""


# Random expressions


Tree = Callable[[SimpleNamespace], Any]
"""Of a namespace with t, x, p, u and the functions of NumPy or of JAX, xp."""

OPERATIONS: dict[str, tuple[int, Callable[..., Any]]] = {
    "+": (2, lambda xp, a, b: a + b),
    "-": (2, lambda xp, a, b: a - b),
    "*": (2, lambda xp, a, b: a * b),
    "ratio": (2, lambda xp, a, b: a / (2.0 + b * b)),
    "gauss": (1, lambda xp, a: xp.exp(-a * a)),
    "square": (1, lambda xp, a: xp.sin(a) * xp.sin(a)),
    **{name: (1, lambda xp, a, name=name: getattr(xp, name)(a)) for name in ("sin", "cos", "tanh")},
}
"""How many operands each has, and its value."""


def constant(value: float, digits: int = 2) -> Tree:
    """A rounded number."""
    value = round(float(value), digits)
    return lambda e: value


def entry(i: int) -> Tree:
    """An entry of x."""
    return lambda e: e.x[i]


def total(*trees: Tree) -> Tree:
    """The sum of expressions."""
    return lambda e: sum(tree(e) for tree in trees)


def multiply(*trees: Tree) -> Tree:
    """The product of two expressions."""
    return lambda e: trees[0](e) * trees[1](e)


def square(tree: Tree) -> Tree:
    """The square of an expression."""
    return multiply(tree, tree)


def scaled(factor: float, tree: Tree) -> Tree:
    """A multiple of an expression."""
    return multiply(constant(factor, 3), tree)


class Expressions:
    """Draws expressions over t, x (n,), parameters and inputs that stay of the order of 1."""

    def __init__(self, rng: np.random.Generator, n: int, parameters: list[tuple[str, int | None]], inputs: int) -> None:
        self.rng, self.n, self.parameters, self.inputs = rng, n, parameters, inputs

    def leaf(self, *, state: bool = True, inputs: bool = False) -> Tree:
        kinds = ["t", "p", "p", "const", *["x"] * (3 * state), *["u"] * (2 * inputs * bool(self.inputs))]
        kind = self.rng.choice(kinds)
        if kind == "x":
            return entry(int(self.rng.integers(self.n)))
        if kind == "p":
            name, k = self.parameters[int(self.rng.integers(len(self.parameters)))]
            return lambda e: e.p[name] if k is None else e.p[name][k]
        if kind == "u":
            place = int(self.rng.integers(self.inputs))
            return lambda e: e.u[place]
        return (lambda e: e.t) if kind == "t" else constant(self.rng.normal())

    def apply(self, kind: str, depth: int, **leaves: bool) -> Tree:
        """An operation of expressions of a depth."""
        count, operation = OPERATIONS[kind]
        parts = [self.tree(depth, **leaves) for _ in range(count)]
        return lambda e: operation(e.xp, *(part(e) for part in parts))

    def tree(self, depth: int, **leaves: bool) -> Tree:
        """An expression of a depth."""
        if depth == 0:
            return self.leaf(**leaves)
        kinds = ["+", "-", "*", "*", "ratio", "sin", "cos", "tanh", "gauss", "square"]
        return self.apply(str(self.rng.choice(kinds)), depth - 1, **leaves)

    def bounded(self, depth: int, **leaves: bool) -> Tree:
        """An expression between -1 and 1."""
        return self.apply(str(self.rng.choice(["sin", "cos", "tanh"])), depth, **leaves)

    def rate(self, i: int, depth: int) -> Tree:
        """The rate of a state: damped, driven by something bounded, with a quadratic term."""
        j, k = self.rng.integers(self.n, size=2)
        damping = scaled(-self.rng.uniform(0.1, 1.2), entry(i))
        driven = scaled(self.rng.normal(), self.bounded(depth, inputs=True))
        return total(damping, driven, scaled(0.15 * self.rng.normal(), multiply(entry(j), entry(k))))

    def jump(self, i: int) -> Tree:
        """A state after a reset."""
        return total(scaled(self.rng.uniform(0.5, 1.0), entry(i)), scaled(0.4, self.bounded(1)))

    def output(self) -> Tree:
        """What a sensor sees, or what a constraint is made of."""
        return total(entry(int(self.rng.integers(self.n))), scaled(0.5, self.bounded(1)))


def vector(trees: list[Tree], xp: Any, *, arguments: str = "txp", flat_input: bool = False) -> Callable[..., Any]:
    """A function that returns the values of expressions: an array for JAX, a list of arrays for the reference."""

    def function(*given: Any) -> Any:
        e = SimpleNamespace(**{"xp": xp, "t": 0.0, **dict(zip(arguments, given, strict=True))})
        if flat_input and xp is jnp:
            e.u = e.u[None]
        values = [tree(e) for tree in trees]
        return values if xp is np else jnp.stack([value + jnp.zeros(()) for value in values])

    return function


def number(tree: Tree, xp: Any, *, arguments: str = "txp") -> Callable[..., Any]:
    """A function that returns the value of one expression."""
    of = vector([tree], xp, arguments=arguments)
    return lambda *given: of(*given)[0]


# Random problems


def draw_features(rng: np.random.Generator, **given: Any) -> SimpleNamespace:
    """What a system has; each is drawn unless it is given."""

    def flag(probability: float) -> bool:
        return bool(rng.random() < probability)

    kinds = ["unknown", "number", "channel", "sample", "parameter", "mixed"]
    drawn = {
        "states": int(rng.choice([1, 2, 3, 4, 6, 8, 10], p=[0.15, 0.25, 0.2, 0.15, 0.1, 0.075, 0.075])),
        "transitions": int(rng.choice([0, 1, 2, 3, 4], p=[0.05, 0.25, 0.35, 0.2, 0.15])),
        "modes": int(rng.integers(1, 4)),
        "runs": 2 if flag(0.2) else 1,
        "input": str(rng.choice(["hold", "linear", "cubic"])) if flag(0.35) else None,
        "tracking": flag(0.25),
        "running": flag(0.3),
        "terminal": flag(0.35),
        "samples": int(rng.choice([0, 1, 2], p=[0.2, 0.6, 0.2])),
        "late": flag(0.15),
        "noise": str(rng.choice(kinds)),
        "robust": flag(0.35),
        "priors": flag(0.35),
        "resets": flag(0.45),
        "guards": flag(0.3),
        "constraints": flag(0.25),
        "initial": str(rng.choice(["numbers", "unknown", "function"])),
        "array": flag(0.2),
        "fixed": flag(0.35),
        "solver": "stiff" if flag(0.03) else "explicit",
    }
    assert given.keys() <= drawn.keys()
    return SimpleNamespace(**{**drawn, **given})


class System:
    """One random problem, for switchfit and for the reference."""

    def __init__(self, seed: int, **given: Any) -> None:
        self.rng = rng = np.random.default_rng([7, seed])
        self.has = has = draw_features(rng, **given)
        self.t0 = float(np.round(rng.uniform(-2.0, 2.0), 2))
        self.tf = self.t0 + float(np.round(rng.uniform(1.0, 2.5), 2))
        self.weighed = has.noise != "unknown"  # robust losses, priors and sigmas need a sigma
        self.inputs = int(rng.integers(1, 3)) if has.input else 0
        self.parameters = self._draw_parameters()
        names = [name for name in self.parameters if name[0] in "abcv"]
        entries = [(name, k) for name in names for k in (range(2) if self.parameters[name].shape else [None])]
        self.expressions = Expressions(rng, has.states, entries, self.inputs)
        depth = 1 if has.states > 4 else 2
        count, states = min(has.modes, 1 + has.transitions), range(has.states)
        self.modes = [[self.expressions.rate(i, depth) for i in states] for _ in range(count)]
        pairs = list(product(range(count), repeat=2))
        jumps, watched = (rng.random(len(pairs)) < on for on in (0.6 * has.resets, 0.6 * has.guards))
        self.resets = {pair: list(map(self.expressions.jump, states)) for pair in compress(pairs, jumps)}
        self.guards = {pair: self.expressions.output() for pair in compress(pairs, watched)}
        self.initial = self._draw_initial()
        self.experiments: list[sf.Experiment] = []
        self.runs: list[reference.Run] = []  # without the places of their unknowns in theta
        for e in range(has.runs):
            self._draw_run(e)

    def _prior(self, value: float, positive: bool) -> Any:
        if not (self.has.priors and self.weighed and self.rng.random() < 0.5):
            return None
        if positive and self.rng.random() < 0.5:
            return sf.LogNormal(value * self.rng.uniform(0.7, 1.4), self.rng.uniform(0.2, 1.0))
        return sf.Normal(value + 0.3 * self.rng.normal(), self.rng.uniform(0.2, 1.0))

    def _parameter(self, value: float, *, positive: bool = False, **settings: Any) -> sf.Parameter:
        prior = None if settings.get("fixed") else self._prior(value, positive)
        return sf.Parameter(value, prior=prior, **({"lower": 0.05} if positive else {}), **settings)

    def _draw_parameters(self) -> dict[str, sf.Parameter]:
        rng, has = self.rng, self.has
        found = {"a": self._parameter(float(rng.uniform(0.3, 1.5)), positive=bool(rng.random() < 0.5))}
        if rng.random() < 0.6:
            found["b"] = self._parameter(float(rng.normal()))
        if has.fixed:
            found["c"] = sf.Parameter(float(rng.normal()), fixed=True)
        if has.array:
            found["v"] = sf.Parameter(rng.normal(size=2), prior=self._prior(0.1, False))
        if has.runs == 2:  # what "a" is in the second run
            found["other"] = self._parameter(float(rng.uniform(0.3, 1.5)), positive=True)
        if has.noise in ("parameter", "mixed"):
            found["sigma"] = self._parameter(float(rng.uniform(0.2, 0.6)), positive=True)
        if has.late:
            found["delay"] = sf.Parameter(float(rng.uniform(0.03, 0.12)), lower=0.0, upper=0.2)
        order = rng.permutation(list(found))
        return {str(name): found[name] for name in order}

    def _draw_initial(self) -> Any:
        values = self.rng.normal(size=self.has.states)
        if self.has.initial == "function":
            return [total(constant(v), scaled(0.5, self.expressions.tree(1, state=False))) for v in values]
        unknown = self.rng.random(self.has.states) < 0.5
        if self.has.initial == "numbers" or not unknown.any():
            return values.tolist()
        return [self._parameter(float(v)) if on else float(v) for v, on in zip(values, unknown, strict=True)]

    def _times(self) -> list[Any]:
        count, span = self.has.transitions, self.tf - self.t0
        gaps = self.rng.uniform(0.3, 1.0, count + 1)
        times = self.t0 + span * np.cumsum(gaps)[:-1] / gaps.sum()
        # A draw decides for each whether it is fixed.
        return [self._parameter(float(t), fixed=bool(self.rng.random() < 0.1 * self.has.fixed)) for t in times]

    def _draw_run(self, e: int) -> None:
        rng, has = self.rng, self.has
        sequence = rng.integers(len(self.modes), size=has.transitions + 1).tolist()
        times = self._times()
        mapped = {"a": "other"} if e == 1 else {}
        run: dict[str, Any] = {"samples": [], "tracking": [], "running": [], "terminal": [], "constraints": []}
        data: list[Any] = []
        for k in range(has.samples):
            self._add_samples(run, data, late=has.late and k == 0)
        if has.tracking:
            self._add_tracking(run, data)
        if has.running:
            tree = total(square(self.expressions.output()), scaled(0.3, self.expressions.bounded(1)))
            run["running"].append(number(tree, np))
            data.append(sf.RunningCost(number(tree, jnp)))
        if has.terminal or not data:
            tree = square(self.expressions.output())
            run["terminal"].append(number(tree, np, arguments="xp"))
            data.append(sf.TerminalCost(number(tree, jnp, arguments="xp")))
        if has.constraints:
            trees = [self.expressions.output() for _ in range(int(rng.integers(1, 3)))]
            run["constraints"].append(vector(trees, np, arguments="xp"))
            data.append(sf.TerminalConstraint(vector(trees, jnp, arguments="xp")))
        inputs, run["input"] = self._draw_input()
        modes = tuple(f"m{k}" for k in sequence)
        settings = {"inputs": inputs, "parameter_map": mapped or None}
        self.experiments.append(sf.Experiment(data, modes, times, self.t0, self.tf, **settings))
        pairs = list(pairwise(sequence))
        self.runs.append(
            reference.Run(
                modes=[vector(self.modes[k], np, arguments="txpu" if self.inputs else "txp") for k in sequence],
                t0=self.t0,
                tf=self.tf,
                times=times,
                initial=None,
                names={name: mapped.get(name, name) for name in self.parameters},
                resets=[vector(self.resets[pair], np) if pair in self.resets else None for pair in pairs],
                guards=[number(self.guards[pair], np) if pair in self.guards else None for pair in pairs],
                **run,
            )
        )

    def _add_samples(self, run: dict[str, Any], data: list[Any], *, late: bool) -> None:
        rng, has = self.rng, self.has
        count, q = int(rng.integers(3, 12)), int(rng.integers(1, 3))
        whole = has.states if rng.random() < 0.2 and not late else 0
        first = self.t0 + 0.25 if late else self.t0 + rng.choice([0.0, 0.1])
        last = self.tf - 0.05 if late else self.tf - rng.choice([0.0, 0.1])
        times = np.sort(rng.uniform(first, last, count))
        if rng.random() < 0.5:
            times[0], times[-1] = first, last
        q = whole or q
        trees = [entry(k) for k in range(q)] if whole else [self.expressions.output() for _ in range(q)]
        values = rng.normal(size=(count, q))
        values[rng.random(values.shape) < 0.1] = np.nan
        values[0, 0] = 0.3
        sigma: Any = {
            "unknown": None,
            "number": 0.4,
            "channel": rng.uniform(0.2, 0.8, q),
            "sample": rng.uniform(0.2, 0.8, (count, q)),
            "parameter": "sigma",
            "mixed": ["sigma", *rng.uniform(0.2, 0.8, q - 1).tolist()],
        }[has.noise]
        loss = str(rng.choice(["soft_l1", "huber", "cauchy"])) if has.robust and self.weighed else "linear"
        scale = float(rng.uniform(1.2, 2.5))
        delay: Any = "delay" if late else 0.0
        if not late and rng.random() < 0.15:
            delay = 0.05
            times = times[times >= self.t0 + delay]
            values = values[-len(times) :]
            sigma = sigma[-len(times) :] if has.noise == "sample" else sigma
            if len(times) == 0 or np.isnan(values).all():
                return
        settings = {"sigma": sigma, "loss": loss, "loss_scale": scale, "delay": delay}
        observe = None if whole else vector(trees, jnp)
        data.append(sf.Measurements(times, values, observe, **settings))
        settings["sigma"] = ["sigma"] * q if isinstance(sigma, str) else sigma
        run["samples"].append(reference.Samples(times, values, vector(trees, np), **settings))

    def _add_tracking(self, run: dict[str, Any], data: list[Any]) -> None:
        rng = self.rng
        count, q = int(rng.integers(4, 9)), int(rng.integers(1, 3))
        times = np.linspace(self.t0, self.tf, count)
        times[1:-1] += rng.uniform(-0.03, 0.03, count - 2)
        values = rng.normal(size=(count, q))
        root = rng.normal(size=(q, q))
        weights = root @ root.T if rng.random() < 0.5 else np.diag(rng.uniform(0.3, 2.0, q))
        trees = [self.expressions.output() for _ in range(q)]
        data.append(sf.ReferenceSignal.from_samples(times, values, observe=vector(trees, jnp), weights=weights))
        signal = reference.Signal.spline(times, values)
        run["tracking"].append(reference.Tracking(signal, vector(trees, np), np.asarray(weights)))

    def _draw_input(self) -> tuple[Any, Any]:
        if not self.inputs:
            return None, None
        rng, kind = self.rng, str(self.has.input)
        times = np.linspace(self.t0, self.tf, int(rng.integers(4, 8)))
        times[1:-1] += rng.uniform(-0.03, 0.03, len(times) - 2)
        values = 0.5 * rng.normal(size=(len(times), self.inputs))
        make = {"hold": reference.Signal.hold, "linear": reference.Signal.linear, "cubic": reference.Signal.spline}
        return sf.Input(times, values[:, 0] if self.inputs == 1 else values, kind), make[kind](times, values)

    @cached_property
    def problem(self) -> sf.Problem:
        """The problem as switchfit takes it."""
        form = {"arguments": "txpu" if self.inputs else "txp", "flat_input": self.inputs == 1}
        initial = vector(self.initial, jnp, arguments="p") if self.has.initial == "function" else self.initial
        modes = {f"m{k}": vector(trees, jnp, **form) for k, trees in enumerate(self.modes)}
        resets = {(f"m{a}", f"m{b}"): vector(trees, jnp) for (a, b), trees in self.resets.items()}
        guards = {(f"m{a}", f"m{b}"): number(tree, jnp) for (a, b), tree in self.guards.items()}
        system = sf.HybridSystem(modes, initial, resets, guards=guards)
        settings = {"solver": self.has.solver, "rtol": RTOL, "atol": ATOL}
        return sf.Problem(system, self.experiments, self.parameters, **settings)

    @cached_property
    def reference(self) -> reference.Reference:
        """The same for the reference; theta is numbered as documented."""
        priors: list[tuple[int, str, float, float]] = []
        count = 0

        def take(parameter: sf.Parameter) -> int:
            nonlocal count
            if parameter.prior is not None:
                kind = "log-normal" if isinstance(parameter.prior, sf.LogNormal) else "normal"
                each = [np.broadcast_to(given, parameter.shape).ravel() for given in vars(parameter.prior).values()]
                priors.extend((count + k, kind, *map(float, own)) for k, own in enumerate(zip(*each, strict=True)))
            count += parameter.value.size
            return count - parameter.value.size

        times = [[float(tau.value) if tau.fixed else take(tau) for tau in run.times] for run in self.runs]
        parameters = {
            name: q.value if q.fixed else (slice(at := take(q), at + q.value.size), q.shape)
            for name, q in self.parameters.items()
        }
        initials: list[Any] = []
        for _ in self.runs:
            if self.has.initial == "function":
                initials.append(vector(self.initial, np, arguments="p"))
            else:
                initials.append([take(x) if isinstance(x, sf.Parameter) else float(x) for x in self.initial])
        placed = zip(self.runs, times, initials, strict=True)
        runs = [replace(run, times=own, initial=initial) for run, own, initial in placed]
        return reference.Reference(runs, parameters, priors)

    @cached_property
    def kinds(self) -> np.ndarray:
        """What each entry of theta is: tau, p, sigma, delay or x0."""

        def kind(name: str) -> str:
            last = name.rpartition(".")[2]
            special = {"sigma": "sigma", "delay": "delay"}
            return "tau" if last.startswith("tau_") else special.get(last, "x0" if last.startswith("x") else "p")

        return np.array([kind(name) for name in self.problem.theta_names])

    def nodes(self, run: Any) -> np.ndarray:
        """Moments of a run at which a transition may tie with something: samples and knots."""
        times = [item.times - item.delay for item in run.samples if not isinstance(item.delay, str)]
        signals = [signal for signal in (*[item.signal for item in run.tracking], run.input) if signal is not None]
        times = np.unique(np.concatenate([*times, *(signal.knots for signal in signals), [self.t0, self.tf]]))
        return times[(times >= self.t0) & (times <= self.tf)]

    def special_theta(self) -> tuple[str, np.ndarray]:
        """A theta at which something coincides, and what: the other unknowns are moved a little too."""
        rng = self.rng
        theta = self.problem.initial_theta
        is_time = self.kinds == "tau"
        theta = np.where(is_time, theta, theta * (1 + 0.03 * rng.normal(size=len(theta))))
        kind = str(rng.choice(["tie", "before", "after", "coincide", "first", "last", "all"]))
        for run in self.reference.runs:
            free = [at for at in run.times if isinstance(at, int)]
            if len(free) < len(run.times) or not free:
                continue
            tau, nodes = theta[free], self.nodes(run)
            k = int(rng.integers(len(tau)))
            node = float(nodes[np.argmin(np.abs(nodes - tau[k]))])
            if kind == "tie":
                tau[k] = node
            elif kind in ("before", "after"):
                away = -np.inf if kind == "before" else np.inf
                tau[k] = np.clip(np.nextafter(node, away), self.t0, self.tf)
            elif kind == "coincide":
                tau[k] = tau[max(k - 1, 0)]
            elif kind == "first":
                tau[0] = self.t0
            elif kind == "last":
                tau[-1] = self.tf
            else:
                tau[:] = node
            theta[free] = np.sort(tau)
        return kind, theta
