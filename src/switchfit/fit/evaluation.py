"""The public function `evaluate`: J of a problem, its exact gradient and its exact Hessian at any theta."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, get_args

from numpy.typing import ArrayLike

from switchfit.arrays import FloatArray
from switchfit.engine.evaluation import Evaluation
from switchfit.meshes.evaluator import evaluator_of
from switchfit.problem.problem import Problem
from switchfit.problem.validation.names import as_choice
from switchfit.problem.validation.objects import as_instance

EvaluationMethod = Literal["auto", "forward", "adjoint"]
EVALUATION_METHODS = get_args(EvaluationMethod)


def evaluate(
    problem: Problem, theta: ArrayLike | None = None, *, method: EvaluationMethod = "auto"
) -> Evaluation[FloatArray]:
    """Evaluate the cost, the exact gradient and the exact Hessian of a problem.

    Parameters
    ----------
    problem : Problem
    theta : (d,) array_like, optional
        In the order of ``problem.theta_names``; the initial guess if left out.
    method : {"auto", "forward", "adjoint"}
        "auto" evaluates the derivatives of the discretized cost by equations written by hand in machine code; JAX
        evaluates them where a function of the model cannot be compiled as straight-line code. "forward" has JAX
        differentiate the discretized cost forward, twice for the Hessian: the same derivatives in ten times the time.
        "adjoint" evaluates the paper's equations (6)-(17), which agree with the others to the integration error.

    Returns
    -------
    Evaluation
        cost, gradient (d,), hessian (d, d); constraints (m,) and jacobian (m, d) if there are guards or terminal
        constraints.

    Raises
    ------
    ValueError
        For a theta of the wrong shape or with transition times out of order, or an unknown method.
    TypeError
        If an argument is of the wrong type.

    Notes
    -----
    The mesh is refined once, at the initial guess, so that J is one smooth function of theta. If a transition time
    equals a sample time, the derivatives are those for increasing it.

    See Also
    --------
    check_derivatives, evaluate_on_guards

    Examples
    --------
    >>> problem = heater_problem()

    >>> exact, paper = (sf.evaluate(problem, method=method) for method in ("forward", "adjoint"))
    >>> bool(abs(exact.gradient - paper.gradient).max() < 1e-4 * abs(exact.gradient).max())
    True
    """
    as_instance(problem, "problem", Problem, "an sf.Problem")
    method = as_choice(method, "method", EVALUATION_METHODS)
    evaluator = evaluator_of(problem)
    at = problem.check_theta(theta)
    found = evaluator(at, method=method)
    held = evaluator.constrained(at) if problem.constraint_names else found
    return replace(found, constraints=held.constraints, jacobian=held.jacobian, stiffness=evaluator.stiffness)
