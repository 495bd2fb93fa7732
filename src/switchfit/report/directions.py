"""Which combinations of unknowns the data determine, and how much J rises along them, as sentences."""

from __future__ import annotations

import numpy as np

from switchfit.problem.validation.messages import unit_suffix
from switchfit.report.tables import wrap_text
from switchfit.report.termination import describe_unread
from switchfit.report.wording import capitalise, join_words
from switchfit.runtime.presentation import format_count, format_text
from switchfit.uncertainty.identification import Direction, Identifiability

RISE_ROUNDING = 1e-12
"""Rise of J, relative to J, that is rounding."""

_PLACES = {"solution": "At the solution", "first guess": "At the first guess"}

_RISES = {
    "noise": "noise hides {} (95 %)",
    "1 % of J": "1 % of J is {}",
    "1 % of variation": "a change of all that is measured by 1 % of how it varies does {}",
}


@format_text.register(Identifiability)
def write_identifiability(found: Identifiability) -> str:
    """Return how many unknowns the data determine, and the combinations that they determine badly.

    Parameters
    ----------
    found : Identifiability
    """
    count, many = len(found.theta_names) - len(found.held), found.undetermined - len(found.without)
    others = ", ".join(name for name in found.without if name not in (*found.unread, *found.absent))
    where = _PLACES[found.where]
    every = f"the data determine all {count} unknowns; condition number of the scaled Hessian"
    not_all = f"the data do not determine {format_count(many, 'combination')} of the {count} unknowns."
    collapsed = f"{', '.join(found.idle)}, because a mode has collapsed: leave it out of mode_sequence."
    # Sentences with whether they apply, in the order in which they are read; a name may appear in one of them only.
    cases = {
        f"{where} the cost does not depend on {others}, to second order.": others,
        f"{capitalise(describe_unread(found.unread, found.absent))}.": found.unread or found.absent,
        f"{where} the cost does not depend on {collapsed}": found.idle,
        f"{where} constraints, kinks and collapsed modes hold all unknowns.": not count,
        f"{where} {every} {found.condition_number:.3g}.": count and not found.undetermined,
        f"{where} {not_all}": count and many > 0,
    }
    lines = [line for sentence, applies in cases.items() if applies for line in wrap_text(sentence, others="")]
    for direction in found.directions if count else ():
        lines += wrap_text(write_direction(found, direction), "  - ", "    ")
    return "\n".join(lines)


def write_direction(found: Identifiability, direction: Direction) -> str:
    """Return which unknowns trade off along a direction, the change that was tried, and the rise of J.

    Parameters
    ----------
    found : Identifiability
    direction : Direction
        One of ``found.directions``.
    """
    # If only the opposite change was possible, describe that one.
    side = -1.0 if np.isnan(direction.rises[0]) and np.isfinite(direction.rises[1]) else 1.0
    # Only the unknowns that matter for the direction, which its names are; its vector has all of them.
    places = [found.theta_names.index(name) for name in direction.names]
    moves = join_words([_format_move(found, i, side * float(direction.change[i])) for i in places])
    # What is little depends on what is known: of the noise, of J, or of how the data vary.
    rise = _RISES[found.meaning].format(f"{found.rise:.2g}") if found.rise > 0 else ""
    seen = f", or the opposite, should raise J little; {rise}."
    seen = _format_rises(direction, rise, found.cost) if found.tried else seen
    return f"{direction.summary} (scaled eigenvalue {direction.eigenvalue:.2g}): {moves}{seen}"


def _format_move(found: Identifiability, i: int, change: float) -> str:
    """Return a change in words: later or earlier for a transition time, higher or lower for other unknowns."""
    up, down = ("later", "earlier") if found.is_time[i] else ("higher", "lower")
    size = f"{abs(change):.2g}{unit_suffix(found.theta_units[i])}"
    return f"{found.theta_names[i]} {size} {up if change > 0 else down}"


def _format_rises(direction: Direction, rise: str, cost: float) -> str:
    """Return the rise of J on both sides of a change, as the end of a sentence."""
    # A side is NaN where constraints leave no room, or J could not be evaluated.
    finite = [r for r in direction.rises if np.isfinite(r)]
    if not finite:
        return ": J could not be evaluated there."
    # The larger of both: neither side raises J by more.
    worst = 0.0 if abs(max(finite)) <= RISE_ROUNDING * abs(cost) else max(finite)
    related = np.isfinite(cost) and abs(worst) < 10 * abs(cost)  # a ratio to a J near 0 means nothing
    relative = f" ({100 * worst / abs(cost):.2g} %)" if related else ""
    both = ", or the opposite," if len(finite) == 2 else ""
    return f"{both} raises J by {worst:.2g}{relative}" + (f"; {rise}." if rise else ".")
