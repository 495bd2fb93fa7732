"""How much of the variance of the data a model explains, as a part of a sentence."""

from __future__ import annotations

import numpy as np

from switchfit.report.wording import get_figure
from switchfit.runtime.issue import Issue


def format_share(share: float) -> str:
    """Return a share in per cent, rounded down to one digit after its leading nines.

    Parameters
    ----------
    share : float
        At most 1.
    """
    if share <= 0:
        return "none"
    if 1 - share < 1e-6:
        return "all but 1e-6" if share < 1 - 1e-12 else "all"
    # As many digits as there are nines: 99.97 % and 99.998 % differ by what they leave. Rounded down, since 100.0 %
    # would be a claim.
    digits = 0 if share < 0.9 else max(int(np.ceil(-np.log10(1 - share))) - 1, 1)
    scaled = share * 10 ** (digits + 2)
    return f"{np.floor(scaled + 1e-9 * scaled) / 10**digits:.{digits}f} %"  # 0.29 * 100 is below 29


def write_explained(issue: Issue) -> str:
    """Return how much of the variance is explained, if there is any, and chi-square if it is known."""
    explained = get_figure(issue, "explained")
    if np.isnan(explained):
        return f"the data do not vary{write_chi_square(issue)}"
    only = " only" if issue.kind in ("unexplained", "little explained") and explained > 0 else ""
    return f"the model explains{only} {format_share(explained)} of the variance{write_chi_square(issue)}"


def write_chi_square(issue: Issue) -> str:
    """Return chi-square and its degrees of freedom in brackets; empty where there is no chi-square."""
    chi_square, freedom = get_figure(issue, "chi-square"), get_figure(issue, "freedom")
    if not np.isfinite(chi_square):
        return ""
    return f" (chi² {chi_square:.3g} for {freedom:.0f} degrees of freedom)".replace("e+0", "e").replace("e+", "e")


def write_worst_explained(issue: Issue) -> str:
    """Return how much of the variance is explained, and how much of the worst channel if that is clearly less."""
    explained, worst = get_figure(issue, "explained"), get_figure(issue, "worst")
    text = write_explained(issue)
    if issue.subjects and 1 - worst > 1.5 * (1 - explained):
        text += f", {format_share(worst)} of {issue.subjects[0]}"
    return text
