"""`Issue`: a warning or a failure about a result, as data; the report writes the sentence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from switchfit.runtime.presentation import Printed


@dataclass(frozen=True)
class Issue(Printed):
    """A warning, a failed check, or the reason why a fit ended; print it for the sentence.

    Attributes
    ----------
    kind : str
        Kind of the issue, such as "collapsed" or "integration error"; `report.issues` lists the kinds.
    subjects : tuple of str
        Names of the unknowns, channels or outputs that it concerns.
    figures : mapping of str to float or tuple of float
        Numbers in the sentence, by name; a tuple has one entry for each subject.

    See Also
    --------
    Certificate.failures, Termination.reason

    Examples
    --------
    >>> issue = sf.Issue("error", ("the log is empty",))
    >>> issue.kind, issue.subjects
    ('error', ('the log is empty',))
    """

    kind: str
    subjects: tuple[str, ...] = ()
    figures: Mapping[str, float | tuple[float, ...]] = field(default_factory=dict)
