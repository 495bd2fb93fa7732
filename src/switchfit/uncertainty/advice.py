"""What to do about the reasons of a verdict: the names of next steps, for which the report has sentences."""

from __future__ import annotations

from switchfit.optimize import Status

LOOK_ELSEWHERE = ("more starts", "look at the residuals")
"""What to do about a model that does not fit: the minimum may be a local one, or the model wrong."""

ADVICE_BY_SUSPECT = {
    "model": ("look at the residuals", "corrected errors"),
    "outliers": ("robust loss",),
    "sigma": ("check sigma",),
}
"""What to do about residuals that are no noise, by what is suspected."""

FIX = "fix or add data"
"""What to do about unknowns that are not determined, which are the subjects of this advice."""

ADVICE_WITHOUT_EFFECT = {
    "not read": "remove or use",
    "acts elsewhere": "fix or let it act",
    "without effect": "fix alone",
}
"""What to do about unknowns on which J does not depend, by the kind of reason; they are the subjects of the advice."""

ADVICE_BY_STATUS = {
    Status.MAX_ITERATIONS: ("raise max_iterations", "more starts"),
    Status.INTERRUPTED: ("continue",),
    Status.NONFINITE_START: ("start elsewhere",),
    Status.INFEASIBLE: ("start nearer",),
}
"""What to do about a fit that did not converge, by its status; otherwise more starts."""

ADVICE_BY_FAILURE = {
    "switch": (),
    "wrong slope": ("check derivatives", "more starts"),
    "rounding": ("larger tolerance",),
}
"""What to do about a line search that failed, by the reason; otherwise more starts. About a switch: see `SWITCH`."""

DEFINE = "define it there"
"""What to do about an operation of a function that is not defined, or has no derivative, at a point."""

WRITTEN_OTHERWISE = {"undefined": DEFINE, "cost corner": "cost as a state"}
"""What to do about a function that kept a fit from converging, by the kind of the reason."""

SWITCH = "transition time"
"""What to do about an unknown with which a function compares, the first of the subjects of this advice."""

OTHER_SIDE = "other side"
"""What to do about transition times that are held by jumps at known times, the subjects of this advice."""

PROFILES = "look at profiles"
"""What to do about transition times that may be elsewhere, the subjects of this advice."""

OF_SUBJECTS = {DEFINE, FIX, SWITCH, OTHER_SIDE, PROFILES, *ADVICE_WITHOUT_EFFECT.values()}
"""Advice that is about the subjects of its reason."""
