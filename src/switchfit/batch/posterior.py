"""The log posterior of a problem as a function that JAX can trace, for samplers such as NUTS.

J with its priors is the negative logarithm of the posterior density up to a constant. Its gradient and Hessian come
from the engine, exactly: JAX gets them as derivative rules and differentiates nothing itself.

Samplers work on vectors z without bounds. The map from z to theta goes through the unknowns in order: a transition
time lies between a ``low`` that follows from the one before it and a ``high`` that leaves room for those after it, and

    theta_i = low_i + (high_i - low_i) / (1 + exp(-z_i)),        log |dtheta/dz| = sum_i log dtheta_i/dz_i,

since dtheta/dz is triangular; with one bound ``theta_i = low + exp(z_i)`` or ``high - exp(z_i)``, without bounds
``theta_i = z_i``. For an estimate these are the entries of ``center + root z``, the covariance of the
fit being ``root root'``, so that z is nearly standard normal: the warm-up of samplers relies on unknowns of size 1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from switchfit.batch.program import Inputs, choose_layout, has_gpu
from switchfit.estimation.estimator import Estimate
from switchfit.fit.evaluator import Evaluator, evaluator_of
from switchfit.fit.result import Fit
from switchfit.problem.data import FloatArray
from switchfit.problem.functions import use_float64
from switchfit.problem.problem import Problem
from switchfit.problem.validation import join_names, shorten
from switchfit.uncertainty.profiles import Limits, limit_unknowns

FLAT = -np.inf
"""Logarithm of a density of zero."""


@dataclass(frozen=True, eq=False)
class LogPosterior:
    """The logarithm of a problem's posterior density, up to a constant: a pure function of theta, for samplers.

    ``posterior(theta)`` and ``posterior.log_density(z)`` can be differentiated twice, compiled with `jax.jit` and
    mapped with `jax.vmap`.

    Attributes
    ----------
    problem : Problem
    theta : (d,) array
        Where the mesh was refined: the estimate, or the first guess.
    evaluator : Evaluator
        The problem on the meshes on which J is evaluated.
    center, root : (d,) and (d, d) arrays
        Of the linear part of the change of variables; for an estimate its theta and a root of its covariance.

    See Also
    --------
    log_posterior : returns it.

    Examples
    --------
    >>> import switchfit as sf
    >>> from switchfit.models import heater_problem
    >>> fit = sf.estimate(heater_problem())

    >>> posterior = sf.log_posterior(fit)
    >>> posterior.names
    ('tau_1', 'k')
    >>> float(posterior(fit.theta)) == -fit.cost, float(posterior([7.0, 0.4]))
    (True, -inf)
    >>> z = posterior.unconstrain(fit.theta)
    >>> z, posterior.constrain(z).round(3)
    (array([0., 0.]), array([2.462, 0.393]))
    """

    problem: Problem
    theta: FloatArray
    evaluator: Evaluator = field(repr=False)
    center: FloatArray = field(repr=False)
    root: FloatArray = field(repr=False)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns, in the order of theta."""
        return self.problem.theta_names

    @property
    def start(self) -> Any:
        """The vector z of `theta`, a start for samplers: (d,)."""
        return self.unconstrain(self.theta)

    def __call__(self, theta: ArrayLike) -> Any:
        """Return the log density of theta (d,): minus infinity outside the bounds, or with times out of order."""
        require_float64(theta)
        with use_float64():
            return self._density(jnp.asarray(theta, dtype=jnp.float64))

    def log_density(self, z: ArrayLike) -> Any:
        """Return the log density of z (d,), whose entries have no bounds: that of theta plus ``log |dtheta/dz|``.

        See Also
        --------
        LogPosterior.constrain

        Examples
        --------
        >>> import jax
        >>> import switchfit as sf
        >>> from switchfit.models import heater_problem

        >>> posterior = sf.log_posterior(heater_problem())
        >>> with jax.enable_x64(True):
        ...     jax.grad(posterior.log_density)(posterior.start).shape
        (2,)
        """
        require_float64(z)
        with use_float64():
            theta, slope = self._transform(jnp.asarray(z, dtype=jnp.float64))
            return self._compute_log_density(theta) + slope

    def constrain(self, z: ArrayLike) -> Any:
        """Return theta of z: (d,), or (..., d) of many; all bounds hold, and transition times are in order.

        See Also
        --------
        LogPosterior.unconstrain

        Examples
        --------
        >>> import switchfit as sf
        >>> from switchfit.models import heater_problem

        >>> posterior = sf.log_posterior(heater_problem())
        >>> posterior.constrain([[0.0, 0.0], [100.0, -100.0]])
        array([[3.   , 2.505],
               [6.   , 0.01 ]])
        """
        require_float64(z)
        with use_float64():
            found = self._constrain(jnp.asarray(z, dtype=jnp.float64))
            return found if isinstance(found, jax.core.Tracer) else np.array(found)

    def unconstrain(self, theta: ArrayLike) -> FloatArray:
        """Return z of theta: (d,). A theta on a bound is moved inside by a millionth of the range.

        Raises
        ------
        ValueError
            For a theta of the wrong shape, or with transition times out of order.

        See Also
        --------
        LogPosterior.constrain

        Examples
        --------
        >>> import switchfit as sf
        >>> from switchfit.models import heater_problem

        >>> posterior = sf.log_posterior(heater_problem())
        >>> posterior.unconstrain([3.0, 2.505]).round(12)
        array([0., 0.])
        """
        at, (before, gap, low, high) = self.problem.check_theta(theta), self._limits
        low = np.where(before >= 0, np.maximum(low, at[before] + gap), low)
        has_low, has_high = np.isfinite(low), np.isfinite(high)
        with np.errstate(divide="ignore", invalid="ignore"):  # what is not chosen
            part = np.clip(np.where(high > low, (at - low) / (high - low), 0.5), EDGE, 1 - EDGE)
            away = np.where(has_low, np.log(np.maximum(at - low, EDGE)), -np.log(np.maximum(high - at, EDGE)))
        z = np.where(has_low & has_high, np.log(part / (1 - part)), np.where(has_low | has_high, away, at))
        return np.asarray(np.linalg.solve(self.root, z - self.center), dtype=np.float64)

    @cached_property
    def _limits(self) -> Limits:
        return limit_unknowns(self.problem)

    @cached_property
    def _density(self) -> Callable[[Any], Any]:
        """The log density of theta, compiled: operation by operation it takes a second the first time."""
        unknowns = self.problem.unknowns

        def compute_density(at: Any) -> Any:
            inside = jnp.all((at >= unknowns.lower) & (at <= unknowns.upper)) & jnp.all(unknowns.A @ at >= unknowns.b)
            found = self._compute_log_density(jnp.where(inside, at, self.theta))
            return jnp.where(inside, found, FLAT)

        return jax.jit(compute_density)

    @cached_property
    def _constrain(self) -> Callable[[Any], Any]:
        """Theta of one z or of many, compiled."""
        return jax.jit(jnp.vectorize(lambda z: self._transform(z)[0], signature="(d)->(d)"))

    def _compute_log_density(self, theta: Any) -> Any:
        unknowns = self.problem.unknowns
        over_log = unknowns.log | unknowns.priors.log  # a density over the logarithm
        away = jnp.where(over_log, theta - unknowns.origin, 1.0)
        found = -self._cost(theta) - jnp.sum(jnp.log(away))
        return jnp.where(jnp.isfinite(found), found, FLAT)

    def _transform(self, z: Any) -> tuple[Any, Any]:
        """Return theta at z (d,), and ``log |dtheta/dz|``."""
        before, gap, lower, upper = self._limits
        z = self.center + jnp.asarray(self.root) @ z
        theta, slopes = _place_between(z, lower, upper)
        for i in np.flatnonzero(before >= 0).tolist():  # each after the time before it
            first = jnp.maximum(lower[i], theta[before[i]] + gap[i])
            own, slope = _place_between(z[i], first, upper[i])
            theta, slopes = theta.at[i].set(own), slopes.at[i].set(slope)
        return theta, jnp.sum(slopes) + np.linalg.slogdet(self.root)[1]

    def _scale_by(self, fit: Fit) -> LogPosterior:
        """Return the same posterior with a z that is nearly standard normal, by the covariance of a fit.

        An unknown that is held, by a kink or a bound, has the width of its interval, and 1 where it has none. So has an
        entry of z that a shortest duration holds: no sampler would leave it otherwise.
        """
        center = self.unconstrain(fit.theta)
        with use_float64():
            slope = np.array(jax.jit(jax.jacfwd(lambda z: self._transform(z)[0]))(jnp.asarray(center)))
        covariance = fit.covariance.copy()
        if not np.isfinite(covariance).all():
            return self
        held = np.diag(covariance) <= 0
        if held.any():
            width = np.diff(fit.confidence_intervals(0.95), axis=1)[:, 0] / 4
            width = np.where(np.isfinite(width) & (width > 0), width, np.abs(np.diag(slope)))
            covariance[held, held] = width[held] ** 2
        back = np.linalg.inv(slope)
        scaled = back @ covariance @ back.T
        Z = fit.free_basis
        moved, terms = (part.max(axis=1, initial=0.0) for part in (np.abs(back @ Z), np.abs(back) @ np.abs(Z)))
        fixed = ~held & (moved <= 10 * EDGE * terms)  # such as the time after a mode that has its shortest duration
        scaled[fixed], scaled[:, fixed] = 0.0, 0.0
        scaled[fixed, fixed] = 1.0
        root = np.asarray(np.linalg.cholesky((scaled + scaled.T) / 2), dtype=np.float64)
        return replace(self, center=center, root=root)

    @cached_property
    def _cost(self) -> Callable[[Any], Any]:
        """J, with its derivatives as rules."""
        layout = choose_layout(self.evaluator, on_gpu=has_gpu())
        inputs = Inputs.of(self.evaluator, layout)

        @jax.jit
        def evaluate(theta: Any) -> tuple[Any, Any, Any]:
            with use_float64():
                J, g, H = inputs.evaluate(layout, (), theta, jnp.ones(()))
                known = jnp.isfinite(J)
                return J, jnp.where(known, g, 0.0), jnp.where(known, H, 0.0)

        differentiate = jax.custom_jvp(lambda theta: evaluate(theta)[:2])
        cost = jax.custom_jvp(lambda theta: evaluate(theta)[0])

        @differentiate.defjvp
        def push_gradient(primals: tuple[Any], tangents: tuple[Any]) -> Any:
            with use_float64():
                J, g, H = evaluate(*primals)
                return (J, g), (g @ tangents[0], H @ tangents[0])

        @cost.defjvp
        def push_cost(primals: tuple[Any], tangents: tuple[Any]) -> Any:
            with use_float64():
                J, g = differentiate(*primals)
                return J, g @ tangents[0]

        return cost


def _place_between(z: Any, low: Any, high: Any) -> tuple[Any, Any]:
    """Return theta between limits, which may be infinite, at z, and ``log dtheta/dz``: (d,) each, or numbers."""
    has_low, has_high = jnp.isfinite(low), jnp.isfinite(high)
    both, one = has_low & has_high, has_low ^ has_high
    width, outwards = jnp.where(both, high - low, 1.0), jnp.where(one, jnp.where(has_low, z, -z), 0.0)
    away = jnp.exp(outwards)
    beside = jnp.where(one, jnp.where(has_low, low + away, high - away), z)
    inside = jnp.log(width) + jax.nn.log_sigmoid(z) + jax.nn.log_sigmoid(-z)
    return jnp.where(both, low + width * jax.nn.sigmoid(z), beside), jnp.where(both, inside, outwards)


def require_float64(given: Any) -> None:
    """Raise ValueError inside a program that JAX compiles in single precision.

    Parameters
    ----------
    given : array or tracer
    """
    if isinstance(given, jax.core.Tracer) and not jax.config.read("jax_enable_x64"):
        raise ValueError(
            "a log posterior inside jax.jit, jax.grad or jax.vmap needs float64, which is not enabled: call "
            'jax.config.update("jax_enable_x64", True), or numpyro.enable_x64(), before anything else.'
        )


EDGE = 1e-6
"""Part of the range by which a theta on a bound is moved inside, where z would be infinite."""


def log_posterior(problem: Problem | Estimate) -> LogPosterior:
    """Return the log posterior of a problem as a pure function of theta that JAX can differentiate, compile and map.

    Parameters
    ----------
    problem : Problem or Estimate
        Of an estimate, the mesh and the start are those at its solution, and z is in units of its covariance, so that
        samplers need no scales; of a problem, mesh and start are those at its first guess.

    Returns
    -------
    LogPosterior

    Raises
    ------
    TypeError
        If it is neither.
    ValueError
        If J is not the negative logarithm of a density: sigma is left out, or the cost has other terms than
        `Measurements` and priors; for guards and terminal constraints; for an estimate without its problem.

    Notes
    -----
    It is ``-J`` up to a constant: half the sum of squares in sigmas, or what a robust loss and a sigma that is a
    parameter make of it, and the priors. An unknown without a prior is flat in theta within its bounds, and one with
    ``scale="log"`` flat in its logarithm; a `LogNormal` prior is a density of the logarithm. J is continuous in a
    transition time, but its slope jumps at each sample; the derivative given there is that for increasing it.

    See Also
    --------
    LogPosterior, profile, bootstrap

    Examples
    --------
    >>> import jax
    >>> import switchfit as sf
    >>> from switchfit.models import heater_problem

    >>> posterior = sf.log_posterior(heater_problem())
    >>> with jax.enable_x64(True):  # samplers need it throughout: jax.config.update("jax_enable_x64", True)
    ...     thetas = jax.numpy.array([[2.4, 0.4], [2.5, 0.4], [2.6, 0.4]])
    ...     jax.vmap(posterior)(thetas).round(1).tolist()
    [-50.2, -8.8, -80.0]
    """
    if isinstance(problem, Estimate):
        evaluator, theta = problem.evaluator_at_solution(), problem.theta
    elif isinstance(problem, Problem):
        evaluator, theta = evaluator_of(problem), problem.initial_theta
    else:
        raise TypeError(f"log_posterior needs an sf.Problem or the result of sf.estimate; got {shorten(problem)}.")
    own = evaluator.problem
    if not own.is_sigma_known:
        raise ValueError(
            "a posterior needs a cost of Measurements with sigma, and of priors, alone: other terms are no "
            "probability. Give sigma a number, or the name of a parameter to sample it with the others."
        )
    if own.constraint_names:
        raise ValueError(
            f"a posterior cannot have equality constraints; this problem has {join_names(own.constraint_names)}. Leave "
            "out the guard, or measure what it says with a sigma of its own."
        )
    d = len(theta)
    posterior = LogPosterior(own, theta.copy(), evaluator, np.zeros(d), np.eye(d))
    return posterior._scale_by(problem) if isinstance(problem, Estimate) else posterior
