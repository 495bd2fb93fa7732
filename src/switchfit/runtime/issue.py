"""`Issue`: something to know about a result, as data. The report has the sentence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from switchfit.runtime.presentation import format_text


@dataclass(frozen=True)
class Issue:
    """A warning, a failed check, or the reason why a fit ended; print it for the sentence.

    Attributes
    ----------
    kind : str
        What it is, such as "collapsed" or "integration error"; the kinds are those in `switchfit.report.sentences`.
    subjects : tuple of str
        Names of what it is about: unknowns, channels, outputs.
    figures : mapping of str to float or tuple of float
        The numbers of the sentence by their names; a tuple has one entry for each subject.

    See Also
    --------
    Certificate.failures, Termination.reason

    Examples
    --------
    >>> import switchfit as sf
    >>> issue = sf.Issue("error", ("the log is empty",))
    >>> issue.kind, issue.subjects
    ('error', ('the log is empty',))
    """

    kind: str
    subjects: tuple[str, ...] = ()
    figures: Mapping[str, float | tuple[float, ...]] = field(default_factory=dict)

    def __str__(self) -> str:
        return format_text(self)
