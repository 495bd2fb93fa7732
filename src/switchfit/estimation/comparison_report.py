"""Text of a comparison of models that were fitted to the same data."""

from __future__ import annotations

import numpy as np

from switchfit.estimation.comparison import ModelComparison
from switchfit.report.tables import Table, format_table, join_sections, wrap_text
from switchfit.report.wording import join_words
from switchfit.runtime.presentation import format_text

_STRENGTHS = ((10.0, "very strong"), (6.0, "strong"), (2.0, "positive"), (0.0, "weak"))
"""Words of Kass and Raftery (1995) for differences in BIC."""

EQUAL_BIC_DIFFERENCE = 0.05
"""Difference in BIC below which models are as good as each other: it would be printed as 0.0."""


@format_text.register(ModelComparison)
def write_comparison(found: ModelComparison) -> str:
    """Return what is best, and a row for each model.

    Parameters
    ----------
    found : ModelComparison
    """
    lines = format_table(*_tabulate_models(found))
    ended = [name for name, fit in zip(found.names, found.estimates, strict=True) if not fit.status.successful]
    if ended:
        lines += wrap_text(f"Not converged: {', '.join(ended)}. Likelihoods of these may be too small.", "  ")
    return join_sections(wrap_text(_write_best(found)), lines)


def _write_best(found: ModelComparison) -> str:
    """Return which model has the smallest BIC and how strong that evidence is, or which models are equally good."""
    order = _list_best_first(found)
    # To the digits that are shown: two models with 0.0 between them, of which one is called better, would puzzle.
    best = [k for k in order if found.delta_bic[k] < EQUAL_BIC_DIFFERENCE]
    are_best = "has the smallest BIC" if len(best) == 1 else "are as good as each other by BIC"
    text = f"{join_words([found.names[k] for k in best])} {are_best}"
    if len(best) < len(order):
        k = order[len(best)]
        strength = next(word for least, word in _STRENGTHS if found.delta_bic[k] >= least)
        text += f", {found.delta_bic[k]:.1f} below {found.names[k]}: {strength} evidence"
    return f"{text}. {found.values} values."


def _tabulate_models(found: ModelComparison) -> Table:
    """Return a row for each model: unknowns, likelihood, AICc and BIC, the best first."""
    rows, titles = [], ["", "unknowns", "log L", "AICc", "delta AICc", "weight", "BIC", "delta BIC"]
    for k in _list_best_first(found):
        aicc = [f"{found.aicc[k]:.2f}", f"{found.delta_aicc[k]:.2f}", f"{found.weights[k]:.2g}"]
        bic = [f"{found.bic[k]:.2f}", f"{found.delta_bic[k]:.2f}"]
        rows.append([found.names[k], f"{found.unknown_counts[k]}", f"{found.log_likelihood[k]:.2f}", *aicc, *bic])
    return Table(rows, "<" + ">" * 7, titles)


def _list_best_first(found: ModelComparison) -> list[int]:
    return np.argsort(found.bic, kind="stable").tolist()
