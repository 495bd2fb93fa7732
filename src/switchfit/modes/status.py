"""How a search for the mode sequence ended: its status, the facts behind it, and warnings, as data."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from switchfit.runtime.presentation import Printed


class ModeStatus(Enum):
    """How a search for the mode sequence ended, and what that means.

    See Also
    --------
    find_modes, ModeSearch

    Examples
    --------
    >>> sf.ModeStatus.FOUND.successful
    True
    """

    FOUND = "One mode sequence explains the data; no other is within 2 of it by mBIC, and all others have less weight."
    AMBIGUOUS = "Another mode sequence is about as good."
    AT_LIMIT = "The best sequence has as many switches as were allowed."
    NOT_EXPLAINED = "No sequence explains the data."
    NOT_CONVERGED = "The fit of the best sequence did not converge."
    UNIDENTIFIED = "A parameter acts in no mode of the library: it is held at its guess."
    INTERRUPTED = "The callback, or Ctrl-C, stopped the search; the result is the best so far."
    NO_SUCCESSION = "first, last and successions admit no sequence with so few switches."

    @property
    def successful(self) -> bool:
        """Whether the sequence may be relied on."""
        return self in (ModeStatus.FOUND, ModeStatus.UNIDENTIFIED)


@dataclass(frozen=True)
class ModeEnding(Printed):
    """How a search ended, as data; print it for a sentence with the remedy.

    Attributes
    ----------
    status : ModeStatus
    sequences : tuple of tuple of str
        Of the best, one for each experiment; empty if there is none.
    other : tuple of tuple of str
        Of the sequence that is about as good.
    difference : float
        mBIC of the other less that of the best, or the criterion if that is no information criterion.
    criterion : str
        By which the number of switches was chosen.
    traceless : bool
        Whether both have the same J with the same parameters: what is measured cannot tell them apart.
    prefers_other : str
        "mbic" if the other is better by it; "as it stands" if it is better by the criterion without a discount for
        residuals that are not noise; empty if neither.
    probability : float
        Of so large a chi-square, or of so correlated residuals, if the model is right.
    reason : {"chi-square", "correlated residuals", "sigma", ""}
        Why the data are not explained; "sigma" if they are with another sigma, which was used.
    ratio : float
        Of that sigma to the given one.
    held : tuple of str
        Parameters that act in no mode of the library.
    limit : int
        max_switches.
    fit : str
        The message of the best fit.

    See Also
    --------
    ModeSearch.ending, find_modes

    Examples
    --------
    >>> search = sf.find_modes(heater_problem(), max_switches=1)
    >>> search.ending.status.name, search.ending.limit
    ('AT_LIMIT', 1)
    >>> print(search.ending)  # doctest: +ELLIPSIS
    At the limit: on -> off has 1 switch, as many as were allowed. Raise max_switches, or give successions ...
    """

    status: ModeStatus
    sequences: tuple[tuple[str, ...], ...] = ()
    other: tuple[tuple[str, ...], ...] = ()
    difference: float = 0.0
    criterion: str = ""
    traceless: bool = False
    prefers_other: str = ""
    probability: float = 1.0
    reason: str = ""
    ratio: float = 1.0
    held: tuple[str, ...] = ()
    limit: int = 0
    fit: str = ""


@dataclass(frozen=True)
class ModeWarning(Printed):
    """What may be wrong with a sequence that was found; print it for a sentence.

    Attributes
    ----------
    kind : {"short segment", "cut off", "correlated residuals", "criteria differ", "discounted", "no trace", \
            "not estimated", "outliers"}
    mode : str
    run : str
        Name of the experiment; empty if there is one.
    begin, end : float
        Of the segment.
    samples : int
        Inside it; or the independent values that all are worth, where criteria were discounted; or outliers.
    channels : tuple of str
        Whose residuals are correlated.
    unit : str
        Of times.
    criterion : str
        That prefers another number of switches.
    switches : int
        That number.
    dispersion : float
        By which 2 J was divided, where criteria were discounted.
    parameters : tuple of str
        That act in none of the modes of the sequence, and keep their guesses.

    See Also
    --------
    ModeSearch.warnings, find_modes

    Examples
    --------
    >>> print(sf.ModeWarning("criteria differ", criterion="mbic", switches=1))
    mBIC prefers 1 switch.
    """

    kind: str
    mode: str = ""
    run: str = ""
    begin: float = 0.0
    end: float = 0.0
    samples: int = 0
    channels: tuple[str, ...] = ()
    unit: str = ""
    criterion: str = ""
    switches: int = 0
    dispersion: float = 1.0
    parameters: tuple[str, ...] = ()
