"""Mistakes in the mathematics that the tests must notice, one at a time: `test_mutations.py` seeds them.

Every mistake is a replacement in a temporary copy of the package, whose text must be found exactly once. The tests of
its part then run against the copy and must fail, while they must pass without a mistake.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

from support import drawn
from support.places import ROOT

SOURCE = ROOT / "src" / "switchfit"

PAPER, DESIGN, OPTIMIZE, ROWS = "paper_adjoint", "experiment_design", "optimize", "discretization"
JAX, NATIVE, CORNERS, SPLIT = "engine/jax", "engine/native", "problem/corners", "engine/corners"


def list_files(room: str, names: str) -> list[str]:
    """Return the paths of files of tests from the root of the repository."""
    return [f"tests/{room}/test_{name}.py" for name in names.split()]


SYSTEMS = ["tests/engine/test_random_systems.py", "-k", "machine_code or each_engine"]
PROTOCOL = list_files("engine", "both_engines closed_forms")
FISHER = [*PROTOCOL, "-m", "slow or not slow", "-k", "derivatives_are_the_same and gauss"]
TESTS = {
    "paper": [["tests/paper/test_adjoint.py"]],
    "rows": [SYSTEMS],
    "native": [SYSTEMS, PROTOCOL],
    "jax": [PROTOCOL, ["tests/modes/test_insertion_rates.py", "-k", "engines_agree"], FISHER],
    "implicit": [
        ["tests/engine/test_implicit_rows.py", "-k", "differences or errors or converge or routine or order or pivots"]
    ],
    "sqp": [list_files("optimize", "sqp sqp_kinks sqp_endings qp")],
    "equalities": [
        ["tests/optimize/test_equalities.py"],
        ["tests/problem/test_free_final_time.py", "-k", "hardly_depends"],
    ],
    "beam": [["tests/strategy/test_known_order.py", "-k", "say"], ["tests/strategy/test_beam.py", "-k", "not jax"]],
    "final time": [
        ["tests/engine/test_closed_forms.py", "-k", "final"],
        ["tests/problem/test_free_final_time.py", "-k", "every_check"],
    ],
    "corners": [
        ["tests/engine/test_closed_forms.py", "-k", "corners"],
        [
            *list_files("problem", "corner_branches corners_at_known_times"),
            *list_files("engine", "corner_derivatives sliding paths_not_followed friction_and_tanks"),
            "-k",
            "once or stays_on or what_slides or infinite_slope or leaves_out or differences or order "
            "or rest or play or sticks or predicts or level or filled or cascade or nearly_shuts or saturate "
            "or rounded or cases",
        ],
    ],
    "online": [list_files("online", "tracking late_and_missing_samples alarms_and_budgets")],
    "design": [[*list_files("experiment_design", "information designs"), *list_files("cli", "design_command")]],
    "kinks": [
        [*list_files("uncertainty", "covariances certificate identifiability residuals"), "-k", "kink or density"]
    ],
    "other minima": [
        [
            *list_files("strategy", "other_minima many_starts ends_of_searches choice_of_strategies known_order"),
            "-k",
            "minimum or minima or budget",
        ]
    ],
    "modes": [
        ["tests/modes/test_schedules.py"],
        [*list_files("modes", "found_sequences verdicts_of_searches searches_kept"), "-m", "not slow"],
    ],
}
"""What must notice the mistakes of each part that were thought of, one after the other until something does."""


def find_test(name: str) -> str:
    """Return the path of a file of tests from the root of the repository, by its name in `drawn.NAMES`."""
    (path,) = (ROOT / "tests").rglob(f"test_{name}.py")
    return path.relative_to(ROOT).as_posix()


SELECTIONS = TESTS | {f"room {room}": [[find_test(name)] for name in names] for room, names in drawn.TESTS.items()}
"""The same, and of those that are drawn."""


Mistake = tuple[str, list[tuple[str, str]]]
"""A room or a file, and texts with what replaces them."""


def swap(where: str, *texts: str) -> Mistake:
    """Return the mistake in a room that replaces the first text by the second, the third by the fourth, and so on."""
    return where, list(zip(texts[::2], texts[1::2], strict=True))


BY_HAND: dict[str, dict[str, Mistake]] = {
    "paper": {
        "sign of X, (8)": swap(PAPER, "X = f_im1.value - f_i.value  # (8)", "X = f_i.value - f_im1.value  # (8)"),
        "coefficient of X_ii 2 -> 1, (13)": swap(PAPER, "- 2 * f_i.D1 @ f_im1.value", "- 1 * f_i.D1 @ f_im1.value"),
        "dropped D ell X, (11)": swap(PAPER, "second = second - Dell @ X + psi", "second = second + psi"),
        "dropped psi . D1^2 f, (12)": swap(PAPER, " - contract(psi, f.D1D1) - f.D1.T", " - f.D1.T"),
        "dropped DpD1 f, (15)": swap(PAPER, "f.D1D1 @ Dp_x + f.DpD1)", "f.D1D1 @ Dp_x)"),
        "dropped Dp f jump, (17)": swap(PAPER, " + here.f_im1.Dp - here.f_i.Dp  # (17)", "  # (17)"),
        "dropped D2 f jump, (13)": swap(PAPER, " + f_im1.D2 - f_i.D2  # (13)", "  # (13)"),
        "dropped D1Dp f Dp_x, (14)": swap(PAPER, " + contract(psi, f.D1Dp @ Dp_x)", ""),
        "tau_j for tau_i, (13), the misprint": swap(
            PAPER,
            "compute_tau_tau(i, here, adjoints, minus, plus)",
            "compute_tau_tau(i, here, adjoints, minus, plus, "
            "[evaluate_transition(model, path, i, tau[j], p).f_im1.D1 for j in range(i)])",
            "i: int, here: TransitionQuantities, adjoints: Adjoints, minus: Sensitivities, plus: Sensitivities",
            "i, here, adjoints, minus, plus, misprinted",
            "X_ij = f_im1.D1 @ minus.Phi_X[:, j]",
            "X_ij = misprinted[j] @ minus.Phi_X[:, j]",
        ),
        "zero cross block, (3)": swap(PAPER, ", cross], [cross.T,", ", 0 * cross], [0 * cross.T,"),
    },
    "rows": {
        "h' in the tangents of the stages": swap(
            ROWS, "states.append(follow(x_d, row, K_d))", "states.append(x_d + h * combine(row, K_d))"
        ),
        "h' in the tangent behind a row": swap(
            ROWS, "K_d, follow(x_d, tableau.b, K_d))", "K_d, x_d + h * combine(tableau.b, K_d))"
        ),
        "D_1 f in the tangents": swap(ROWS, "times_vector(J, states[-1]) + given", "times_vector(J, x_d) + given"),
        "later stages in the adjoint": swap(ROWS, "(b[j] * psi + later)", "(b[j] * psi)"),
        "a transposed in the adjoint": swap(ROWS, "combine(a[j + 1 :, j], mu", "combine(a[j + 1 :].diagonal(j), mu"),
        "psi in the adjoint": swap(ROWS, "psi + sum(mu[1:], mu[0])", "sum(mu[1:], mu[0])"),
        "ell in what the length multiplies": swap(
            ROWS, "((psi * slopes[j]).sum() + densities[j])", "(psi * slopes[j]).sum()"
        ),
        "mu in what the length multiplies": swap(
            ROWS,
            "(mu[j] * combine(tableau.a[j], slopes)).sum()",
            "0.0 * combine(tableau.a[j], slopes).sum()",
        ),
        "times of the stages": swap(ROWS, "[start_d + c * h_d for c", "[end_d - c * h_d for c"),
    },
    "native": {
        "the time of a transition in a node": swap(
            NATIVE, 'g = g + g_t.item() * graph.load("moves", 0, vector=True)', "g = g + 0.0"
        ),
        "functions of another stage of a row": swap(
            NATIVE, 'graph.load("kept", j * len(kept) + k, certain', 'graph.load("kept", k, certain'
        ),
        "half of the mixed entries in Z' S Z": swap(
            NATIVE, "for one, other in {(k, m), (m, k)}:", "for one, other in {(k, m)}:"
        ),
        "the length of a row in the Hessian": swap(
            NATIVE, '+ graph.load("length", d) * (end_d - start_d)', "+ 0.0 * (end_d - start_d)"
        ),
        "the sample behind a transition": swap(NATIVE, "(cell >= begin)", "(cell > begin)"),
        "W in the Gauss-Newton matrix": swap(NATIVE, "hb * apply_weights(W, A)", "hb * A"),
    },
    "jax": {
        "weights of the stages": swap(
            ROWS, "[model.mode_of_segment][layout.segment]", "[model.mode_of_segment][layout.segment, ::-1]"
        ),
        "samples at t0 in the costates": swap(JAX, "jnp.where(s.cell[:, None] < 0, 0.0, s.weight)", "s.weight"),
        "the Fisher information of sigma": swap(JAX, "H + 2.0 * jnp", "H + 1.0 * jnp"),
        "rho' in the Gauss-Newton matrix": swap(JAX, "r_d, weight, r_d", "r_d, jnp.sign(weight), r_d"),
        "W in the Gauss-Newton matrix": swap(JAX, "jax.vmap(partial(apply_weights, W))(at_stages)", "at_stages"),
    },
    "implicit": {
        "D_1 f x' in the tangents": swap(ROWS, "[given + times_vector(J, X_d) for", "[given for"),
        "h' in the tangents of the stages": swap(ROWS, "known = [follow(x_d, row, ())", "known = [x_d"),
        "a transposed in the adjoint": swap(ROWS, "combine(a[:, j], costs)", "combine(a[j], costs)"),
        "the transposed equations": swap(ROWS, ".solve(right, transposed=True)", ".solve(right)"),
        "f in the error of a row": swap(
            ROWS, "DAMPING * (h * slope + combine(STIFF_ERROR, k))", "DAMPING * combine(STIFF_ERROR, k)"
        ),
        "the factors of the last row": swap(
            NATIVE, '"x", "Z", *OF_STAGES)', '"x", "Z", "X", "XZ") | writer.at_row(found, 0, "kept")'
        ),
        "no second derivative of Newton's map": swap(
            NATIVE,
            "second[j] = list_entries(S, with_time=moving)",
            "second[j] = list_entries(S * (not tableau.coupled), with_time=moving)",
        ),
        "the order of the states": swap(NATIVE, "x[np.argsort(self._order)]", "x"),
        "pivots of a routine": swap(NATIVE, "is_larger.choose(row,", "is_larger.choose(k,"),
        "a row that does not converge": swap(NATIVE, 'store(float("nan"),', "store(0.0,"),
        "rounding errors of a state": swap(NATIVE, "CHANGE = 1e-10, 1e-12", "CHANGE = 1e-10, 0.0"),
        "slopes of a row that moves": swap(NATIVE, "(found.slopes if moving else [])", "([] if moving else [])"),
        "the length of a row in the Hessian": swap(
            NATIVE, 'K_d.append(graph.loads("XZ", n, (count + j) * n, vector=True))', "K_d.append(X_d)"
        ),
    },
    "sqp": {
        "absolute values of eigenvalues": swap(
            OPTIMIZE,
            "replaced = xp.maximum(xp.abs(values), EIGENVALUE_REPLACEMENT)",
            "replaced = xp.maximum(values, 1e-3)",
        ),
        "the decrease that a step must achieve": swap(
            OPTIMIZE,
            "((decrease <= noise) | (cost <= before - fraction * decrease))",
            "(cost <= before + 1e300 * fraction)",
        ),
        "the size in what is active": swap(
            OPTIMIZE, "16 * EPS * (abs_b + abs_A @ size)", "0.0 * (abs_b + abs_A @ size)"
        ),
        "bounds that press are reached exactly": swap(
            OPTIMIZE,
            "np.where(own > 0.0, lower, np.where(own < 0.0, upper, step))",
            "np.where(own > 0.0, 0.999 * lower, step)",
        ),
    },
    "equalities": {
        "second-order correction": swap(OPTIMIZE, "or not correcting:", "or True:"),
        "the penalty is raised": swap(
            OPTIMIZE, "return penalty if penalty >= needed else PENALTY_INCREASE * needed", "return penalty"
        ),
        "a violation that does not change ends it": swap(
            OPTIMIZE, "return equalities.predict(normal) > FALL * point.violation", "return False"
        ),
        "constraints are measured anew": swap(
            OPTIMIZE, "np.where(lengths > GROWN, lengths, 1.0)", "np.ones(len(lengths))"
        ),
        "the constraints in the Hessian of the Lagrangian": swap(OPTIMIZE, "self.multipliers / units)", "0.0 * units)"),
        "bounds of the normal step": swap(OPTIMIZE, "if cube.holds(shortest):", "if True:"),
        "dependent rows": swap(OPTIMIZE, "sizes > DEPENDENT * sizes[0]", "sizes >= 0.0"),
        "curvature along the constraints alone": swap(
            OPTIMIZE,
            "np.vstack([constraints.normals[rows], point.equalities(point.reported_sides).jacobian])",
            "constraints.normals[rows]",
        ),
        "kinks that keep constraints from being met": swap(
            OPTIMIZE, "if point.kink is None or found.left <= max(HALF * point.violation, MET):", "if True:"
        ),
    },
    "final time": {
        "the running cost at tf": swap(ROWS, "if self.structure.is_rest(mode):", "if False:"),
        "rest after tf": swap("problem", "return jnp.zeros_like(x)", "return 0.1 * x"),
        "ell(tf) in (6)": swap(
            PAPER,
            "ell_before(t, x, p) - ell_after(t, R(t, x, p), p)",
            "ell_before(t, x, p) - ell_before(t, R(t, x, p), p)",
        ),
        "D ell behind tf in (11)": swap(PAPER, "jax.grad(ell_after, argnums=1)", "jax.grad(ell_before, argnums=1)"),
    },
    "modes": {
        "fits without corners": swap("modes", "not any(map(has_corners, problem.structures))", "True"),
        "parameters that do not act are free": swap("modes", "lower[held] = upper[held] = theta[held]", "pass"),
        "guarded times count": swap("modes", 'if name == "cost" else fitted.free_switches', "if name else 0"),
        "a switch counts once in mBIC": swap("modes/criterion.py", 'each = 2 if name == "mbic" else 1', "each = 1"),
        "what follows a pulse": swap("modes/schedule.py", "names[j if closes else j + 1 :]", "names[j + 1 :]"),
        "reset maps of another sequence": swap(
            NATIVE,
            "self._named[name][:] = which",
            "self._named[name][:] = which if name == 'modes' else -1",
        ),
    },
    "kinks": {
        "what follows a kink": swap("fit", "+ follow @ V @ follow.T", "+ 0.0 * follow @ V @ follow.T"),
        "half of J in the density": swap("uncertainty", "np.exp(-np.concatenate(", "np.exp(-0.5 * np.concatenate("),
        "second moment": swap("fit", "(Z - g * (1.0 - g * Z) / s) / s", "(Z + g * (1.0 - g * Z) / s) / s"),
    },
    "other minima": {
        "points on the same path": swap("strategy", "if evaluator.paths == path:", "if evaluator.paths != path:"),
        "one point beside a minimum": swap("strategy", "BEYOND = (2.0, 4.0, 6.0)", "BEYOND = (2.0,)"),
        "the exact Hessian alone": swap("strategy", '= ("exact", "gauss-newton")', '= ("exact",)'),
        "one model of an interval": swap("strategy", "RIGHT = 8, 4, 0.2", "RIGHT = 8, 1, 0.2"),
        "none beside a minimum": swap("strategy", "hops += look_near(", "_ = look_near("),
        "chi-square hides nothing": swap("strategy", "DEEP = 10.0", "DEEP = 0.0"),
        "a sigma makes up for what others are to fit": swap("strategy", " & ~evaluator.problem.is_sigma", ""),
        "rivals inside of the interval": swap("strategy", "if not low <= value <= high", "if low <= value <= high"),
        "only a known sigma": swap("strategy", "strict_minimum and scale > 0.0", "strict_minimum and fit.sigma_known"),
        "compilation counts": swap("strategy", "limit_time(most, measure_work,", "limit_time(most, time.perf_counter,"),
        "re-insertion has the last word": swap("strategy", "return len(steps) > 2 and", "return len(steps) > 1 and"),
    },
    "beam": {
        "sign of the jump in Z": swap(NATIVE, "+ sign * graph.loads(", "- sign * graph.loads("),
        "dropped F_p": swap(
            NATIVE,
            "forcing = [self._along_p(graph, f_p) for",
            "forcing = [self._along_p(graph, 0.0 * f_p) for",
        ),
        "column one slot off": swap(NATIVE, "Column.SLOT) + 1", "Column.SLOT) + 2"),
        "a birth before the sample at its time": swap(
            NATIVE,
            'self.invoke("at_node", table, record, here + 1)',
            'self.invoke("at_node", table, record, here)',
        ),
        "the highest scores of a place are kept": swap(
            NATIVE, "leave(score >= self._load_score", "leave(score <= self._load_score"
        ),
        "dropped penalty": swap("strategy", " + self.penalty * switches", ""),
        "dropped limit for each sequence": swap("strategy", "PER_SEQUENCE = 3", "PER_SEQUENCE = 3000"),
        "sign of the shift": swap(NATIVE, 'graph.load("x", i) + (', 'graph.load("x", i) - ('),
        "scores for costs": swap("strategy", "costs = states.costs + ((g", "costs = states.scores + 0 * ((g"),
        "sign of what other runs say": swap("strategy", "Q, Q @ center - g", "Q, Q @ center + g"),
        "own parameters of other runs that do not follow": swap(
            "strategy",
            "solved = np.linalg.pinv(self.Q[np.ix_(others, others)], rcond=1e-10, hermitian=True)",
            "solved = np.zeros((len(others), len(others)))",
        ),
        "the rate of a guard": swap(NATIVE, 'weight = graph.load("tolerances", 2) / (rate', "weight = 2.0 / (rate"),
    },
    "corners": {
        "the tangent of a crossing's time": swap(
            SPLIT, "T[times] = -np.linalg.solve(square, A[rows[:, None], others])", "T[times] = 0.0"
        ),
        "the multipliers of guards in the Hessian": swap(
            SPLIT, 'if matrix == "exact" and len(split.guards):', "if False:"
        ),
        "times of crossings at another theta": swap(SPLIT, "times[split.guarded] -= step", "pass"),
        "a path that does not hold any more": swap(
            SPLIT, "if found is not None and self._holds(split, times, p):", "if found is not None:"
        ),
        "the side behind a crossing": swap(
            SPLIT, "if leads_back and may_rest else behind", "if not may_rest else behind"
        ),
        "what changes nothing": swap(SPLIT, "(kinds >= 0) & ~is_idle, is_idle", "kinds >= 0, kinds > 1e9"),
        "what is touched": swap(SPLIT, "if touched.any():", "if False:"),
        "rounding at rest": swap("engine/adaptive", "coarse), p, smallest)", "coarse), p)"),
        "sliding": swap(SPLIT, "else -1\n        return 0", "else -1\n        return 1"),
        "a jump of the input": swap(SPLIT, "if after != self.sides:", "if False:"),
        "the end of sliding": swap(CORNERS, "[each := next(s), 1.0 - each]", "[1.0 + abs(next(s)), 1.0]"),
        "motion of a corner in time": swap(CORNERS, "[jnp.ones_like(t), f]", "[jnp.zeros_like(t), f]"),
        "motion of a corner with the input": swap(CORNERS, "jnp.stack([u[1], ", "jnp.stack([0.0 * u[1], "),
        "sliding ends where the input bends": swap(SPLIT, "== 0, drift, 0.0)", "== 2, drift, 0.0)"),
        "an output beyond its corner": swap("problem", "return choose_sides(trace(", "return (trace("),
        "left on the wrong side": swap(SPLIT, "2.0 * np.minimum(self._last[0], 0.0)", "0.0 * self._last[0]"),
        "both corners in the convex combination": swap(
            CORNERS, "(b[0] - sum(c * s for c, s in zip", "(b[0] + sum(c * s for c, s in zip"
        ),
        "the other case of a selection": swap(
            CORNERS,
            "found = cases[int(which.flat[0])]",
            "found = lax.select_n(which, *map(jnp.asarray, cases))",
        ),
        "corners that are one": swap(CORNERS, "tuple(sorted(pair))", "pair"),
        "a rounded state that jumps": swap(
            CORNERS, "_choose(is_even, odd, even) + more", "_choose(is_even, odd, even)"
        ),
        "corners of two states that are not one": swap(CORNERS, '"argument", k, i', '"argument", k, 0'),
        "the margin of a steep corner": swap(CORNERS, "if sides[k] == side:", "if False:"),
        "rates at a steep corner": swap(SPLIT, "if exact[:, k].max() <= STILL_STEEP * exact.max():", "if False:"),
        "passed by an error of the solver": swap(
            SPLIT, "if found is not None and not self._returns(found, inside):", "if found:"
        ),
        "a Gauss-Newton matrix called exact": swap(
            SPLIT, 'if split.has_gauss_newton and matrix == "exact":', "if False:"
        ),
        "the size of a corner where a mode begins": swap(
            SPLIT, "= self._guess_scale(t, x, inside)", "= np.zeros(self.corners.count)"
        ),
    },
    "online": {
        "what has left the window is a diagonal": swap(
            "online", "(self.matrix + artificial)[None]", "(np.diag(np.diag(self.matrix)) + artificial)[None]"
        ),
        "what has left the window counts half": swap("online", "slope = along[:, :D]", "slope = 0.5 * along[:, :D]"),
        "no minimum along what has no effect": swap(
            "online",
            "H -= row[:, :, None] * row[:, None, :] / pivot",
            "H -= 0 * row[:, :, None] * row[:, None, :] / pivot",
        ),
        "a new value is not joined to the old one": swap(
            "online", "[[1.0, -1.0], [-1.0, 1.0]]", "[[1.0, 0.0], [0.0, 1.0]]"
        ),
        "the old value still moves the state": swap(
            "online", "tangent[:, :entries], tangent[:, chosen] = 0.0, 0.0", "tangent[:, :entries] = 0.0"
        ),
        "the hypotheses that decide are not propagated anew": swap(
            "online", "found.records[chosen] = anew.records[good]", "anew.records[good]"
        ),
        "a late sample changes nothing before it": swap(
            "online", "changed = min(changed, node)", "changed = min(changed, node + 1)"
        ),
        "a late sample keeps its time stamp": swap(
            "online", "t - float(self._sensors.items[k].delay)", "t - 0 * float(self._sensors.items[k].delay)"
        ),
        "a model that has lost the samples recovers": swap("online", "self._lost = now", "self._lost = None"),
        "inputs hold before they come": swap("online", "return given if before is None else before", "return given"),
        "the journal forgets the inputs": swap("online", '"u": u}', '"u": None}'),
    },
    "design": {
        "sign of the criterion's slope": swap(DESIGN, "return mean, -xp.swapaxes", "return mean, xp.swapaxes"),
        "A in place of D": swap(DESIGN, '{"D": 0.0,', '{"D": 1.0,'),
        "information of one side": swap(DESIGN, "SIDES = (1, -1)", "SIDES = (1, 1)"),
        "scales left out": swap(DESIGN, "basis[self.chosen] / self.scales[:, None]", "basis[self.chosen]"),
        "priors and other runs left out": swap(DESIGN, "self.information - sum(found))", "0 * self.information)"),
        "guarded times stay where they are": swap("fit", "Z[guarded] = -np.linalg", "Z[guarded] = -0 * np.linalg"),
        "weights of samples left out": swap(DESIGN, "taken, C, w, C)", "taken, C, w**0, C)"),
        "information of sigma once": swap(DESIGN, "+ 2.0 * jnp.einsum", "+ 1.0 * jnp.einsum"),
        "gradient of one side": swap(DESIGN, ".mean(0)", "[0]"),
        "limits of inputs ignored": swap(DESIGN, "bounds=[(0.0, 1.0)]", "bounds=[(-1.0, 2.0)]"),
        "samples of two sensors are exchanged": swap(DESIGN, "~taken & (sensor == sensor[out])", "~taken"),
        "no exchange": swap(DESIGN, "while improved:", "while not improved:"),
    },
}
"""Those that were thought of, by part and name."""

MISTAKES = {(part, name): mistake for part, found in BY_HAND.items() for name, mistake in found.items()} | {
    (f"room {room}", name): swap(path, text, mistaken)
    for room, name, path, text, mistaken in drawn.draw_mistakes(SOURCE)
}
"""All of them, with those that are drawn."""


def mutate(part: str, name: str) -> dict[str, str]:
    """Return the files of a mistake with the mistake in them; ValueError unless the room has each text exactly once."""
    where, replacements = MISTAKES[part, name]
    paths = sorted((SOURCE / where).rglob("*.py")) or [(SOURCE / where).with_suffix(".py")]
    files = {str(path.relative_to(SOURCE)): path.read_text() for path in paths}
    changed = {}
    for old, new in replacements:
        counts = {path: text.count(old) for path, text in files.items() if old in text}
        if list(counts.values()) != [1]:
            raise ValueError(f"{where}: found in {counts} instead of once: {old!r}")
        (path,) = counts
        changed[path] = files[path] = files[path].replace(old, new)
    return changed


def copy_package(folder: Path) -> Path:
    """Copy the package below a folder and return its path."""
    ignored = shutil.ignore_patterns("__pycache__")
    return Path(shutil.copytree(SOURCE, folder / "switchfit", ignore=ignored))


def find_failure(package: Path, part: str, cache: Path) -> str | None:
    """Run the tests of a part against a copy of the package and return the first test that fails, or None.

    Parameters
    ----------
    package : Path
        As of `copy_package`.
    part : str
    cache : Path
        Folder for compiled programs, which may be shared: they are found by their text, which a mistake changes.

    Raises
    ------
    RuntimeError
        If the tests cannot be collected, or the interpreter crashes.
    """
    environment = os.environ | {
        "PYTHONPATH": str(package.parent),
        "PYTHONDONTWRITEBYTECODE": "1",
        "SWITCHFIT_CACHE": str(cache),
        "OMP_NUM_THREADS": "1",
    }
    environment.pop("PYTEST_ADDOPTS", None)
    for selection in SELECTIONS[part]:
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-n", "0", "-p", "no:cacheprovider", *selection]
        run = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
        if run.returncode < 0:
            return "the interpreter, which has crashed"
        failed = re.findall(r"^(?:FAILED|ERROR) \S+?::(.*?)(?: - .*)?$", run.stdout, re.MULTILINE)
        if run.returncode not in (0, 1) or (run.returncode == 1 and not failed):
            raise RuntimeError(f"pytest ended with {run.returncode}:\n{run.stdout[-3000:]}\n{run.stderr[-3000:]}")
        if run.returncode == 1:
            return str(failed[0])
    return None
