"""A fit with what follows from its model: certificate, verdict, intervals, covariances, computed when asked for."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, Self, get_args

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.fit.result import invert
from switchfit.fit.solved_fit import SolvedFit
from switchfit.fit.statistics import measure_quantile
from switchfit.meshes.evaluator import Evaluator
from switchfit.problem.validation.names import as_choice
from switchfit.uncertainty.certificate import Certificate, certify
from switchfit.uncertainty.corrected_errors import correct_errors, measure_widening
from switchfit.uncertainty.density_intervals import replace_where_cost_jumps
from switchfit.uncertainty.identification import Identifiability, identifiability
from switchfit.uncertainty.profile_pieces import replace_intervals
from switchfit.uncertainty.residuals import ResidualDiagnostics, diagnose
from switchfit.uncertainty.sample_derivatives import build_gauss_newton, collect_sample_derivatives
from switchfit.uncertainty.sensitivity import Sensitivity, compute_sensitivities
from switchfit.uncertainty.transition_profiles import HIGHEST_LEVEL, compute_threshold, trace_profiles
from switchfit.uncertainty.verdict import Verdict, judge

CovarianceKind = Literal["exact", "gauss-newton", "sandwich"]

MOST_SENSITIVITIES = 2**28
"""Largest size, in bytes, of the derivatives of states and outputs at all nodes; above it, figures have no bands."""


@dataclass(frozen=True, eq=False)
class JudgedFit(SolvedFit):
    """A fit with its verdict: what a search compares, and what `Estimate` shows.

    Attributes
    ----------
    saved_certificate : Certificate or None
        Of a fit that was loaded.
    """

    saved_certificate: Certificate | None = None

    @cached_property
    def certificate(self) -> Certificate:
        """Checks of the numbers. The paper's equations are evaluated for it, at the first access.

        An estimate that was loaded without its model has the certificate that was saved.
        """
        if self.saved_certificate is not None:
            return self.saved_certificate
        self.__dict__.pop("verdict", None)  # from now on it includes the check of derivatives
        return certify(self, None if self.problem is None else Evaluator(self.problem, self.theta))

    @property
    def known_certificate(self) -> Certificate | None:
        """The certificate, if it was loaded or computed before; else None."""
        return self.saved_certificate or self.__dict__.get("certificate")

    @cached_property
    def verdict(self) -> Verdict:
        """Whether to believe the numbers: good, doubtful or bad, why, and what to do next. Print it for one line.

        It includes the check of derivatives if the certificate was accessed before, or loaded.
        """
        return judge(self, self.known_certificate)

    @property
    def success(self) -> bool:
        """Whether the fit converged and its verdict is not bad; ``status.successful`` says whether it converged."""
        return self.status.successful and self.verdict.level != "bad"

    @property
    def corrected_standard_errors(self) -> FloatArray:
        """Standard errors that allow for correlated residuals: (d,); `standard_errors` without such residuals.

        They are the standard errors times sqrt((1 + r) / (1 - r)), where r is the correlation of neighboring residuals,
        and if sigma is known times the root mean square of the residuals in sigmas. The largest factor of all channels
        counts; for a transition time, that of the channels of its own run.
        """
        return correct_errors(self)

    @cached_property
    def corrected_covariance(self) -> FloatArray:
        """Covariance that allows for correlated residuals: (d, d); `covariance` without such residuals.

        Its standard errors are `corrected_standard_errors`, its correlations those of `covariance`. Bands of fitted
        curves follow from it.
        """
        factors = measure_widening(self)
        return np.asarray(factors[:, None] * self.covariance * factors)

    @cached_property
    def gauss_newton(self) -> FloatArray | None:
        """The Gauss-Newton matrix ``sum (D h / sigma)' (D h / sigma)``: (d, d); None if it is unknown."""
        if self.saved_gauss_newton is not None or self.sigma_known is None or self.problem is None:
            return self.saved_gauss_newton
        if not self.problem.estimates_delays and self.has_room_for_sensitivities():
            # From the program of the exact Hessian, which the fit has compiled: 1 ms, and 0.7 s with one of its own.
            samples = collect_sample_derivatives(self.problem, self.sensitivities)
            return build_gauss_newton(self.problem, self.theta, samples)
        return self.evaluator_at_solution()(self.theta, matrix="gauss-newton").hessian

    def covariance_from(self, hessian: CovarianceKind) -> FloatArray:
        """Return the covariance of theta from the exact Hessian, the Gauss-Newton matrix or both sides of it: (d, d).

        Parameters
        ----------
        hessian : {"exact", "gauss-newton", "sandwich"}
            "exact", the observed information, is used by `covariance` and everything else here. The Gauss-Newton
            matrix, the expected information, omits ``sum r D^2 h / sigma^2``: it is positive semi-definite for any
            residuals, and treats the model as linear. "sandwich" is ``n / (n - d) H^-1 B H^-1`` with the exact Hessian
            H and ``B = sum_k g_k g_k'``, g_k being the gradient of the cost of sample k: with a robust loss it holds
            for independent noise of any distribution, whether sigma is right or not. With any of them, unknowns at
            kinks have variances as in `covariance`; those of the sandwich are rough, as each score is of one side.

        Raises
        ------
        ValueError
            For another kind. For "gauss-newton" if the matrix is unknown: it needs a cost of Measurements alone, and
            the problem, unless it was saved. For "sandwich" without the problem, with a cost of other terms,
            with priors, constraints, or a sigma or delay that is a parameter, and with no more values than free
            unknowns.

        References
        ----------
        P. J. Huber, Robust Statistics, Wiley 1981, section 6.3 (covariance of M-estimates); H. White, Maximum
        likelihood estimation of misspecified models, Econometrica 50 (1982) 1-25, theorem 3.2; J. G. MacKinnon,
        H. White, J. Econometrics 29 (1985) 305-325 (the factor n / (n - d)).

        See Also
        --------
        Estimate.covariance

        Examples
        --------
        >>> fit = sf.estimate(heater_problem())

        >>> fit.covariance_from("gauss-newton").shape
        (2, 2)
        """
        if as_choice(hessian, "hessian", get_args(CovarianceKind)) == "exact":
            return self.covariance
        if hessian == "gauss-newton":
            if self.gauss_newton is None:
                raise ValueError(
                    "The Gauss-Newton matrix of this fit is not known: it needs a cost of Measurements alone, and the "
                    "problem. Use hessian='exact'."
                )
            return self.variance_scale * invert(self, self.gauss_newton, self.variance_scale)
        if self.problem is None or not self.has_sandwich:
            raise ValueError(
                "The sandwich covariance needs the gradient of each sample: the problem, with a cost of Measurements "
                "alone, without guards, terminal constraints, priors, and parameters that are a sigma or a delay, and "
                "with more values than free unknowns. Use hessian='exact', or sf.profile."
            )
        # MacKinnon and White (1985), HC1, of White (1982), theorem 3.2: C = n / (n - d) H^-1 B H^-1, B = scores' scores
        scores = collect_sample_derivatives(self.problem, self.sensitivities).scores
        spread = scores @ invert(self, self.hessian, self.variance_scale)
        return np.asarray(self.samples / self.freedom * (spread.T @ spread))

    @property
    def has_sandwich(self) -> bool:
        """Whether there is a ``covariance_from("sandwich")``."""
        has_gradients = self.problem is not None and self.sigma_known is not None and self.problem.has_plain_samples
        return has_gradients and not self.constraints and self.freedom > 0

    def has_room_for_sensitivities(self) -> bool:
        """Return whether the derivatives of states and outputs at all nodes take less memory than `MOST_SENSITIVITIES`.

        See Also
        --------
        Estimate.plot, Estimate.predict

        Examples
        --------
        >>> fit = sf.estimate(heater_problem())

        >>> fit.has_room_for_sensitivities()
        True
        """
        rows = sum(len(mesh.nodes) for mesh in self.evaluator_at_solution().meshes)
        width = 2 * max(trajectory.states.shape[1] for trajectory in self.trajectories)  # about as many outputs
        # Before and after each row, 8 bytes each.
        return 16 * rows * width * len(self.theta) <= MOST_SENSITIVITIES

    @cached_property
    def sensitivities(self) -> tuple[Sensitivity, ...]:
        """States and outputs with their derivatives in theta, one per experiment, on the meshes of the fit."""
        return compute_sensitivities(self.evaluator_at_solution(), self.theta)

    def confidence_intervals(self, level: float = 0.95, *, hessian: CovarianceKind = "exact") -> FloatArray:
        """Return intervals of all unknowns, cut off at the bounds: (d, 2).

        The interval is ``theta +- quantile x standard error``. For unknowns on a logarithmic scale, theta is multiplied
        and divided by exp(quantile x relative standard error). For a transition time at a kink, or with a sample time
        within five standard errors, it is the range in which 2 (J − J_min) of its profile, followed piece by piece,
        stays below the squared quantile: slope and curvature of the cost jump at every sample time, so that this
        interval is not symmetric. Where what is measured jumps at a transition, J itself jumps at samples, and the
        interval is the middle part of the density exp(-J) of the profile: chi-square does not hold (Hansen 2000).
        An estimate that was loaded without its model has these profiles up to level 0.99;
        one with more than 15 experiments, guards, terminal constraints, or a model with thin layers has ``theta +-
        quantile x standard error`` only. NaN for an unknown that is held by a bound or a collapsed mode.

        Parameters
        ----------
        level : float, between 0 and 1
            The quantile is that of Student's t if sigma is unknown, of the normal distribution if it is known.
        hessian : {"exact", "gauss-newton", "sandwich"}
            As in `covariance_from`. With the last two, no profile is followed at kinks and among samples, and with
            "sandwich" the quantile is that of Student's t in any case.

        See Also
        --------
        profile, bootstrap

        Examples
        --------
        >>> fit = sf.estimate(heater_problem())

        >>> fit.confidence_intervals(0.95).round(2)
        array([[2.43, 2.5 ],
               [0.38, 0.4 ]])
        """
        intervals = super().confidence_intervals(level)
        if hessian != "exact":
            quantile = measure_quantile(level, max(self.freedom, 1), self.sigma_known and hessian != "sandwich")
            return self.build_intervals(quantile * np.sqrt(np.diag(self.covariance_from(hessian))))
        pieces, places = self._trace_profiles(level)
        found = replace_intervals(intervals, pieces, places, np.array(compute_threshold(self, level)))
        return replace_where_cost_jumps(found, pieces, places, self, level)

    def _trace_profiles(self, level: float = HIGHEST_LEVEL) -> tuple[FloatArray, NDArray[np.intp]]:
        """Return the profiles of transition times with samples near; without the model those that were saved."""
        if self.problem is None:
            return self.saved_pieces, self.saved_piece_places
        return trace_profiles(self, self.problem, self.evaluator_at_solution(), level)

    @cached_property
    def identifiability(self) -> Identifiability:
        """Which combinations of the unknowns the data determine badly, with J evaluated there."""
        return identifiability(self)

    @property
    def residuals(self) -> ResidualDiagnostics:
        """Tests of the residuals, channel by channel: whiteness, effective sample size."""
        return diagnose(self)

    def complete(self) -> Self:
        """Return the fit with all fields that are saved: computes the Gauss-Newton matrix, and the profiles of
        transition times with samples near.

        See Also
        --------
        Estimate.save

        Examples
        --------
        >>> fit = sf.estimate(heater_problem())

        >>> fit.complete().saved_pieces.shape[0]
        1
        """
        pieces, places = self._trace_profiles()
        matrix = self.gauss_newton
        return replace(self, saved_gauss_newton=matrix, saved_pieces=pieces, saved_piece_places=places)
