"""Transition times that a fit holds beside a sample, where J jumps as a reset map passes what is measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from switchfit.optimize import Result, Status, minimize
from switchfit.optimize.minimization_problem import MinimizationProblem as Minimization

BESIDE_SAMPLE, NEAR_SAMPLE = 2e-9, 1e-6
"""Distance from a sample, as a part of the horizon, at which a time is held, and within which it is looked for. It is
just not at the sample for intervals."""


def hold_at_jumps(posed: Minimization, result: Result) -> Result:
    """Return the end of a fit with transition times held beside samples: as a time passes one, what is measured is that
    before a reset map and not that behind it, and J jumps. The result itself where that is no minimum.
    """
    again, held = result, dict[int, float]()
    lower, upper = posed.constraints.lower.copy(), posed.constraints.upper.copy()
    while again.status is Status.LINE_SEARCH_FAILED:
        theta, count = again.theta.copy(), len(held)
        for i, nodes in posed.breakpoints.of_coordinates:
            node = min(nodes, key=lambda node: abs(node - theta[i]))
            length, beside = nodes[-1] - nodes[0], np.repeat(theta[None], 2, axis=0)
            if i in held or not nodes[0] < node < nodes[-1] or abs(node - theta[i]) > NEAR_SAMPLE * length:
                continue
            beside[:, i] = node + BESIDE_SAMPLE * length * np.array([-1.0, 1.0])
            given = [np.zeros(len(posed.equalities))] if posed.equalities else []
            before, after = (posed.evaluate(each, 1, *given).cost for each in beside)
            if abs(after - before) > NEAR_SAMPLE * abs(again.cost):
                side = int(after < before)
                (upper, lower)[side][i] = theta[i] = beside[side, i]
                held[i] = (before - after) / (BESIDE_SAMPLE * length)
        if len(held) == count:
            return result
        constraints = replace(posed.constraints, lower=lower, upper=upper)
        again = minimize(replace(posed, constraints=constraints), theta)
    if not (held and again.status.successful):
        return result
    multipliers, kinks, rows, d = again.multipliers.copy(), list(again.kinks), len(posed.constraints.b), len(lower)
    at = [(i, steep) for i, steep in held.items() if again.theta[i] in (lower[i], upper[i])]
    bounds = [place + i for i, _ in at for place in (rows, rows + d)]
    for i, steep in at:
        slope = float(multipliers[rows + i] - multipliers[rows + d + i])  # of J, along the guards where there are any
        left, right = sorted((slope, -steep))  # across the sample J rises steeply
        kinks.append((i, left, right))
    multipliers[bounds] = 0.0
    named = [posed.constraints.names[place] for place in bounds]
    return replace(
        again,
        status=Status.CONVERGED_AT_KINK if at else again.status,
        active=tuple(each for each in again.active if each not in named),
        multipliers=multipliers,
        kinks=tuple(sorted(kinks)),
        iterations=result.iterations + again.iterations,
        evaluations=result.evaluations + again.evaluations,
        history=(*result.history, *again.history[1:]),
    )
