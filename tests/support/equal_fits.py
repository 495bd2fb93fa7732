"""What makes two results the same, to the bit."""

from dataclasses import fields, is_dataclass

import numpy as np

from switchfit.fit.termination import Kink
from switchfit.problem.constraints import ActiveConstraint
from switchfit.runtime.issue import Issue
from switchfit.uncertainty.certificate import Certificate

CERTIFICATE = Certificate(
    optimality=2e-9, smallest_eigenvalue=np.nan, smallest_scaled_eigenvalue=0.1, condition_number=np.inf,
    worst_unknowns=("tau_1", "mu"), integration_error=1e-12, gradient_gap=5e-324, hessian_gap=1.7976931348623157e308,
    taylor_orders=(np.nan, 2.0, 3.0), kinks=(Kink("tau_1", 4.0, -1.0, np.inf),),
    active=(
        ActiveConstraint("lower bound", 0.05, "mu", multiplier=3.0),
        ActiveConstraint("collapsed", 0.0, mode='ü"\\', position=0, multiplier=np.nan),
    ),
    failures=(Issue("Taylor orders", figures={"orders": (np.nan, 1.0, 2.0)}),),
)  # fmt: skip


def describe(value):
    """All that a value is, in types and values throughout, arrays in dtype, shape and bits, to be compared."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if is_dataclass(value):
        return type(value), {field.name: describe(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, (tuple, list)):
        return type(value), [describe(each) for each in value]
    if isinstance(value, dict):
        return [(key, describe(each)) for key, each in value.items()]
    return type(value), repr(value)


def assert_same(a, b):
    """Equal in type and value throughout; arrays in dtype, shape and bits."""
    assert describe(a) == describe(b)
