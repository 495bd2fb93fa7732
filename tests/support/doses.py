"""Doses into one compartment at known times, whose concentrations have a closed form."""

import numpy as np

import switchfit as sf
from support.models import decay as eliminate
from support.models import one_run

DOSES = np.array([0.0, 8.0, 16.0, 24.0])
AMOUNT = 100.0
TIMES = np.arange(0.0, 37.0)
"""Four of the samples are at the times of doses: they are of the state before."""

TRUE = {"k": 0.13, "V": 11.0}
GUESS = {"k": 0.2, "V": sf.Parameter(8.0, lower=1.0)}


def dose(t, x, p):
    return x + AMOUNT / p["V"]


BODY = sf.HybridSystem({"eliminate": eliminate}, [0.0], state_names=("c",))


def concentration(k, V):
    """c (K,), its slopes (K, 2) and curvatures (K, 2, 2) in k and V: a sum of decaying doses."""
    since = TIMES[:, None] - DOSES
    each = np.where(since > 0, AMOUNT / V * np.exp(-k * since), 0.0)
    c, ck, ckk = each.sum(1), -(since * each).sum(1), (since**2 * each).sum(1)
    slopes = np.stack([ck, -c / V], axis=1)
    curvatures = np.stack([np.stack([ckk, -ck / V], 1), np.stack([-ck / V, 2 * c / V**2], 1)], 1)
    return c, slopes, curvatures


def make_log(values):
    return sf.Measurements(TIMES, values, sigma=0.1)


ALL = sf.Jump(DOSES, dose)


def make_problem(values, jumps=ALL, **options):
    return one_run(BODY, make_log(values), ["eliminate"], [], None, GUESS, time_unit="h", jumps=jumps, **options)
