"""The judgement on a search: which number of switches, whether it may be relied on, and what may be wrong.

The number is chosen by a criterion. The best sequence and its alternatives have weights, those of mBIC where BIC or
mBIC chooses.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from switchfit.estimation.estimates import Estimate
from switchfit.modes.certifier import Certifier
from switchfit.modes.criterion import INFORMATION, CriterionName, compute_weights
from switchfit.modes.fitted import Fitted
from switchfit.modes.fitter import Fitter
from switchfit.modes.neighbours import CHANGE_WITHOUT_TRACE
from switchfit.modes.noise import UNEXPLAINED, is_far_from_noise, measure_whiteness
from switchfit.modes.pool import ModeSequences, Pool
from switchfit.modes.result import ModeFit
from switchfit.modes.schedule import Schedule
from switchfit.modes.status import ModeEnding, ModeStatus, ModeWarning
from switchfit.problem.reads import find_read
from switchfit.problem.validation.arrays import as_number
from switchfit.strategy.beam_grid import list_sample_times

AMBIGUOUS = 2.0
"""Difference of the criterion below which another sequence is about as good."""

ALTERNATIVE = 10.0
"""Difference of the criterion below which a sequence is an alternative."""

AT_BOUND = 1e-6
"""How much longer than its shortest duration a mode may be, as a part of it, to be at that bound."""

LEAST_WEIGHT_OF_BEST = 0.5
"""Weight of the best below which all others together are as likely."""

FEW_SAMPLES = 5
"""Samples below which a mode may make up for an error of the model."""


@dataclass(frozen=True)
class Judge:
    """Chooses the number of switches, and judges the best sequence.

    Attributes
    ----------
    pool : Pool
        What was fitted.
    fitter : Fitter
    certifier : Certifier
    chooser : str or callable
        The criterion that chooses the number.
    interrupted : bool
    untraced : list of ModeWarning
        Modes that could be put into the best and leave no trace.
    """

    pool: Pool
    fitter: Fitter
    certifier: Certifier
    chooser: CriterionName | Callable[[Estimate], float]
    interrupted: bool
    untraced: list[ModeWarning]

    def conclude(self) -> dict[str, Any]:
        """Choose the number of switches, and return what was found: these fields of `ModeSearch`."""
        ranked = self._rank()
        if not ranked:
            return {"ending": ModeEnding(ModeStatus.NOT_CONVERGED, limit=self.certifier.library.max_switches)}
        best = ranked[0][0]
        estimate = self.certifier.estimate(best) if best.has_unknowns else None
        weights, values = self._weigh(ranked), {fit.sequences: value for fit, value in ranked}
        # By a criterion of the user's the best need not have the lowest J of its number of switches.
        shown = [best if fit.switches == best.switches else fit for fit in self.pool.by_switches.values()]
        return {
            "fitted": tuple(self._describe(fit, values, weights) for fit in shown),
            "chosen": tuple(self._describe(fit, values, weights) for fit, _ in ranked if fit.sequences in weights),
            "best": estimate,
            "ending": self._end(ranked, estimate, weights[best.sequences]),
            "warnings": () if estimate is None else tuple(self._list_warnings(best, estimate)),
        }

    @property
    def _chooses_by_cost(self) -> bool:
        return not self.pool.is_likelihood or self.chooser == "cost"

    def _weigh(self, ranked: list[tuple[Fitted, float]]) -> dict[ModeSequences, float]:
        """Return the weights of the best and its alternatives.

        Weights are those of mBIC where BIC or mBIC chooses: BIC does not count that the place of a switch was searched
        for, and is no approximation of a probability of sequences with different numbers of switches.
        """
        if self._chooses_by_cost or not np.isfinite(ranked[0][1]):
            return {ranked[0][0].sequences: 1.0}
        values = [self.pool.compute(fit, "mbic") if self._weighs_by_mbic else value for fit, value in ranked]
        # The best is always among them, also where mBIC alone would leave it out.
        kept = [k for k, value in enumerate(values) if k == 0 or value <= min(values) + ALTERNATIVE]
        weights = compute_weights([values[k] for k in kept]).tolist()
        return {ranked[k][0].sequences: weight for k, weight in zip(kept, weights, strict=True)}

    @property
    def _weighs_by_mbic(self) -> bool:
        # AICc chooses by prediction and not by the probability of a number: only a discount makes mBIC decide for it,
        # too.
        of_number = self.chooser != "aicc" or self.pool.as_it_stands is not None
        return of_number and self.pool.score.has_information(self.chooser)

    def _rank(self) -> list[tuple[Fitted, float]]:
        """Return what was fitted with the criterion by which the number is chosen, the lowest first."""
        if not callable(self.chooser):
            return [(fit, self.pool.compute(fit)) for fit in self.pool.list_best()]
        fits = [fit for fit in self.pool.by_switches.values() if fit.has_unknowns]
        pairs = [(fit, as_number(self.chooser(self.certifier.estimate(fit)), "criterion(estimate)")) for fit in fits]
        return sorted((pair for pair in pairs if np.isfinite(pair[1])), key=lambda pair: pair[1])

    def _describe(
        self, fit: Fitted, values: dict[ModeSequences, float], weights: dict[ModeSequences, float]
    ) -> ModeFit:
        pool, known = self.pool, self.certifier.find(fit.sequences)
        # The estimate was fitted on meshes of its own to the full tolerance: where there is one, its numbers are
        # reported.
        cost, times = fit.cost, tuple(schedule.times for schedule in fit.schedules)
        if known is not None:
            cost, times = known.cost, tuple(np.array(t) for t in known.transition_times)
        likely = {name: pool.compute(fit, name, discounted=False) for name in INFORMATION} if pool.is_likelihood else {}
        return ModeFit(
            sequences=fit.sequences,
            transition_times=times,
            parameters=fit.parameters,
            acting=fit.acting,
            cost=cost,
            criterion=values.get(fit.sequences, np.nan),
            weight=weights.get(fit.sequences, 0.0),
            **likely,
        )

    def _end(self, ranked: list[tuple[Fitted, float]], estimate: Estimate | None, weight: float) -> ModeEnding:
        """Return how the search ended; `weight` is that of the best."""
        best = ranked[0][0]
        facts: dict[str, Any] = {
            "sequences": best.sequences,
            "criterion": self.chooser if isinstance(self.chooser, str) else "criterion",
            "held": self._list_held(best, read=False),
            "limit": self.certifier.library.max_switches,
        }
        # In this order: what makes all later judgements meaningless ends it.
        if self.interrupted:
            return ModeEnding(ModeStatus.INTERRUPTED, **facts)
        if estimate is not None and not estimate.status.successful:
            return ModeEnding(ModeStatus.NOT_CONVERGED, **facts, fit=estimate.message)
        unexplained = self._find_misfit(best, estimate)
        if unexplained is not None:
            return ModeEnding(ModeStatus.NOT_EXPLAINED, **facts, probability=unexplained[0], reason=unexplained[1])
        if self._is_at_limit(best):
            return ModeEnding(ModeStatus.AT_LIMIT, **facts)
        doubt = {} if self._chooses_by_cost else self._find_doubt(ranked, weight)
        if doubt:
            return ModeEnding(ModeStatus.AMBIGUOUS, **facts | doubt)
        return ModeEnding(ModeStatus.UNIDENTIFIED if facts["held"] else ModeStatus.FOUND, **facts)

    def _list_held(self, best: Fitted, *, read: bool) -> tuple[str, ...]:
        """Return the parameters that act in none of the modes found, if functions of the library read them or not."""
        problem = self.fitter.problem
        known = find_read(problem, problem.structures, library=True)
        entries = zip(self.fitter.parameter_names, best.acting.tolist(), known.tolist(), strict=True)
        return tuple(name for name, acts, is_read in entries if not acts and is_read == read)

    def _find_doubt(self, ranked: list[tuple[Fitted, float]], weight: float) -> dict[str, Any]:
        """Return the sequence that makes the best ambiguous, and by what; empty if there is none."""
        best, lowest = ranked[0]
        if self.pool.as_it_stands is not None and self.pool.as_it_stands.sequences != best.sequences:
            return {"other": self.pool.as_it_stands.sequences, "prefers_other": "as it stands"}
        gaps: dict[ModeSequences, float] = {}
        for other, value in ranked[1:]:
            by_mbic = self.pool.compute(other, "mbic") - self.pool.compute(best, "mbic")
            # BIC and AICc alone are close for many a short pulse, whose place was searched for.
            gaps[other.sequences] = by_mbic if self._weighs_by_mbic else max(value - lowest, by_mbic)
        if not gaps:
            return {}
        nearest, gap = min(gaps.items(), key=lambda item: item[1])
        traceless = next((other for other, _ in ranked[1:] if _leave_same_trace(best, other)), None)
        if traceless is not None:  # whatever a criterion says of parameters that leave no trace either
            return {"other": traceless.sequences, "difference": gaps[traceless.sequences], "traceless": True}
        preferred = self.pool.list_best("mbic")[0].sequences
        if preferred != best.sequences:
            return {"other": preferred, "prefers_other": "mbic", "difference": gaps.get(preferred, gap)}
        if gap < AMBIGUOUS or (self.pool.score.has_information(self.chooser) and weight < LEAST_WEIGHT_OF_BEST):
            return {"other": nearest, "difference": gap}
        return {}

    def _find_misfit(self, best: Fitted, estimate: Estimate | None) -> tuple[float, str] | None:
        """Return the probability by which the data are not explained, and of what; None if they are."""
        if not self.pool.is_likelihood:
            return None
        probability = self.pool.measure_probability(best)
        if probability < UNEXPLAINED:
            return probability, "chi-square"
        if estimate is not None and is_far_from_noise(estimate, self.pool.score):
            return measure_whiteness(estimate), "correlated residuals"
        return None

    def _is_at_limit(self, best: Fitted) -> bool:
        """Return whether an experiment has as many switches as allowed, and could have more."""
        most = self.certifier.library.max_switches
        if not any(schedule.switches == most for schedule in best.schedules):
            return False
        # With two modes that alternate, the limit may be odd where only even numbers can follow: that is no limit.
        longer = replace(self.certifier.library, max_switches=most + len(self.certifier.library.modes) + 1)
        return any(switches > most for switches in longer.possible_switches)

    def _list_warnings(self, best: Fitted, estimate: Estimate) -> Iterable[ModeWarning]:
        """Yield what may be wrong with the best sequence."""
        pool = self.pool
        names = self.certifier.given.run_names if len(best.schedules) > 1 else ("",)
        for label, schedule, run in zip(names, best.schedules, self.certifier.given.experiments, strict=True):
            yield from self._list_cut(schedule, label, run.time_unit)
            times = list_sample_times(run)
            for mode, begin, end in zip(schedule.sequence, schedule.knots[:-1], schedule.knots[1:], strict=True):
                count = int(np.sum((times >= begin) & (times <= end)))
                if schedule.switches and count < FEW_SAMPLES and len(times):
                    yield ModeWarning("short segment", mode, label, float(begin), float(end), count, unit=run.time_unit)
        if pool.is_likelihood and estimate.status.successful:
            residuals = estimate.residuals
            pairs = zip(residuals.labels, residuals.correlated, strict=True)
            correlated = tuple(name for name, bad in pairs if bad)
            if correlated:
                yield ModeWarning("correlated residuals", channels=correlated)
            for name in ("bic", "mbic"):
                _, switches = min((pool.compute(fit, name, discounted=False), fit.switches) for fit in pool)
                if switches != best.switches:
                    yield ModeWarning("criteria differ", criterion=name, switches=switches)
        if pool.as_it_stands is not None:
            worth, dispersion = round(pool.score.worth * pool.score.values), pool.score.dispersion
            yield ModeWarning("discounted", samples=worth, dispersion=dispersion, switches=best.switches)
        yield from self.untraced
        held = self._list_held(best, read=True)
        if held:
            yield ModeWarning("not estimated", parameters=held)

    def _list_cut(self, schedule: Schedule, run: str, unit: str) -> Iterable[ModeWarning]:
        """Yield the first and the last mode if min_duration makes them longer: a log may begin in the middle of one."""
        for i in {0, schedule.switches} if schedule.switches else ():
            mode, (begin, end) = schedule.sequence[i], schedule.knots[i : i + 2].tolist()
            least = self.certifier.library.durations[mode]
            if least > 0 and end - begin <= least * (1 + AT_BOUND):
                yield ModeWarning("cut off", mode, run, begin, end, unit=unit)


def _leave_same_trace(one: Fitted, other: Fitted) -> bool:
    """Return whether two sequences of equal length with the same parameters have the same J."""
    return (
        one.switches == other.switches
        and abs(one.cost - other.cost) <= CHANGE_WITHOUT_TRACE * one.cost
        and np.allclose(one.parameters, other.parameters, rtol=1e-4, atol=0.0)
    )
