"""Every experiment and figure of Section V of the paper, with its numbers compared to ours.

One module per part. Each has ``compute(quick, folder, say)``, which returns results as plain numbers and lists,
``draw(found)``, which draws figures from these alone, and ``rows(found)``, lines of the table. `run` runs all parts.

References
----------
L. M. Miller, T. D. Murphey, Simultaneous optimal estimation of mode transition times and parameters applied to simple
traction models.
"""

from switchfit.paper.runner import PARTS, run

__all__ = ["PARTS", "run"]
