"""How a search for the mode sequence ended, and what may be wrong with the sequence, as sentences."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from switchfit.modes.status import ModeEnding, ModeStatus, ModeWarning
from switchfit.problem.validation.messages import join_names, unit_suffix
from switchfit.runtime.presentation import format_count, format_text

CRITERION_TITLES = {"bic": "BIC", "mbic": "mBIC", "aicc": "AICc", "cost": "J + cost of switches"}

CRITERION_ROUNDING = 1e-6
"""Difference of a criterion that no data decide: two fits of the same curve differ by it."""

_SEARCH_ENDINGS = {
    "FOUND": "Found: {best}.",
    "undiscounted": "Ambiguous: {best}; or {other}, which {criterion} prefers if the residuals are taken for noise, "
    "which they are not. Improve the model, or give successions or a min_duration.",
    "other criterion": "Ambiguous: {criterion} prefers {best}, {other_criterion} prefers {other}. Longer data, "
    "successions or a min_duration may decide.",
    "exchanged": "Ambiguous: {best}, and {other}, which is the same with other values of the parameters: the functions "
    "of these modes can take each other's place. Say which is which by first, last or bounds of the parameters.",
    "traceless": "Ambiguous: {best}, or {other}: which of them leaves no trace in what is measured. Measure another "
    "state, or give first, last or successions.",
    "close": "Ambiguous: {best}, and {other}, whose {compared} is only {difference:.2g} higher. Longer data, "
    "successions or a min_duration may decide.",
    "AT_LIMIT": "At the limit: {best} has {most}, as many as were allowed. Raise max_switches, or give successions or "
    "a min_duration.",
    "NOT_EXPLAINED": "Not explained: no sequence explains the data. The best is {best}, but {why}. A mode may be "
    "missing from the library, or an effect from the model; check sigma, or give starts for the parameters.",
    "sigma": "Not explained, unless sigma is {ratio:.2g} times as large as given: the residuals of {best} are white "
    "noise of that size. If sigma is right, a mode may be missing from the library, or an effect from the model.",
    "nothing fitted": "Not converged: no sequence could be fitted. Give better guesses of the parameters, or starts.",
    "NOT_CONVERGED": "Not converged: the fit of {best} ended otherwise. {fit}",
    "UNIDENTIFIED": "Found: {best}. But {parameters} in no mode of the library, and cannot be estimated. Fix it, leave "
    "it out, or add the mode that it belongs to.",
    "INTERRUPTED": "Interrupted: the best so far is {best}. Search on with the same folder, or with better guesses.",
    "NO_SUCCESSION": "No succession: first, last, successions and min_duration admit no sequence with at most {most}. "
    "Raise max_switches, or add successions.",
}
"""By the name of the status, or of a case of it."""

_UNLIKELY = {
    "chi-square": "chi-square would be so large with a probability of {:.1e} if the model were right",
    "correlated residuals": "the residuals are correlated (a probability of {:.1e} if they were white)",
}
"""Why the data are not explained."""

_WARNINGS = {
    "cut off": "{where} is as short as its min_duration allows, and the log may begin or end in the middle of it: give "
    "this mode a smaller min_duration.",
    "short segment": "{where} has {count}: it may make up for an error of the model. Give a min_duration, and see "
    "whether the data need it.",
    "correlated residuals": "the residuals of {names} are correlated: modes may make up for an error of the model, and "
    "standard errors are too small.",
    "discounted": "{number} by the discounted mBIC: the residuals are not noise, and the values count as the {samples} "
    "independent ones that they are worth{larger}.",
    "outliers": "{count} are outliers: they were weighed by a robust loss. Give loss='huber' to the measurements.",
    "no trace": "{where} leaves no trace in what is measured: it may have been so or not.",
    "not estimated": "{acting} in modes that do not occur: {guesses}, without a standard error.",
    "criteria differ": "{preferring} prefers {number}.",
}


def _join_sequence(sequences: Sequence[Sequence[str]]) -> str:
    """Return mode sequences in one line."""
    return " | ".join(" -> ".join(modes) for modes in sequences)


def name_criterion(name: str) -> str:
    """Return the name of a criterion as it is written."""
    return CRITERION_TITLES.get(name, name)


def _is_exchanged(ending: ModeEnding) -> bool:
    """Return whether the other sequence is the best one with its modes renamed, and as good but for rounding."""
    each = list(zip(ending.sequences, ending.other, strict=True))
    # A renaming is a bijection of modes: no two pairs share a side. Equal costs are needed as well, since any two
    # sequences of two modes are renamings of each other.
    pairs = {pair for best, other in each for pair in zip(best, other, strict=False)}
    same_lengths = all(len(best) == len(other) for best, other in each)
    renamed = len({best for best, _ in pairs}) == len({other for _, other in pairs}) == len(pairs)
    return same_lengths and renamed and abs(ending.difference) < CRITERION_ROUNDING


def _name_case(ending: ModeEnding) -> str:
    """Return the key of the sentence."""
    if ending.reason == "sigma":
        return "sigma"
    if ending.status is ModeStatus.NOT_CONVERGED and not ending.sequences:
        return "nothing fitted"
    if ending.status is not ModeStatus.AMBIGUOUS:
        return ending.status.name
    if ending.prefers_other:
        return "undiscounted" if ending.prefers_other == "as it stands" else "other criterion"
    if ending.traceless:
        return "traceless"
    return "exchanged" if _is_exchanged(ending) else "close"


@format_text.register(ModeEnding)
def write_ending(ending: ModeEnding) -> str:
    """Return how a search ended as a sentence, with the remedy.

    Parameters
    ----------
    ending : ModeEnding
    """
    # All that any of the sentences may name; each takes what it needs.
    fields = vars(ending) | {
        "best": _join_sequence(ending.sequences),
        "other": _join_sequence(ending.other),
        "criterion": name_criterion(ending.criterion),
        "other_criterion": name_criterion(ending.prefers_other),
        # Alternatives are compared by the mBIC, which prices a switch as searching for it costs.
        "compared": name_criterion("mbic" if ending.criterion == "bic" else ending.criterion),
        "most": format_count(ending.limit, "switch", "switches"),
        "why": _UNLIKELY.get(ending.reason, _UNLIKELY["correlated residuals"]).format(ending.probability),
        "parameters": _name_acting(ending.held),
    }
    return _SEARCH_ENDINGS[_name_case(ending)].format(**fields)


def _name_acting(names: Sequence[str]) -> str:
    """Return names and the verb, such as "k acts"."""
    return f"{join_names(names)} {'acts' if len(names) == 1 else 'act'}"


@format_text.register(ModeWarning)
def write_warning(warning: ModeWarning) -> str:
    """Return what may be wrong with a sequence as a sentence.

    Parameters
    ----------
    warning : ModeWarning
    """
    run = f" of {warning.run}" if warning.run else ""
    span = f"{warning.begin:.6g} to {warning.end:.6g}{unit_suffix(warning.unit)}"
    sigma = f", and sigma as {np.sqrt(warning.dispersion):.2g} times larger" if warning.dispersion > 1 else ""
    fields = vars(warning) | {
        "where": f"{warning.mode}{run} from {span}",
        "count": format_count(warning.samples, "sample"),
        "names": ", ".join(warning.channels),
        "number": format_count(warning.switches, "switch", "switches"),
        "larger": sigma,
        "acting": _name_acting(warning.parameters),
        "guesses": "it keeps its guess" if len(warning.parameters) == 1 else "they keep their guesses",
        "preferring": name_criterion(warning.criterion),
    }
    return _WARNINGS.get(warning.kind, _WARNINGS["criteria differ"]).format(**fields)
