"""Every experiment and figure of Section V of the paper, with the paper's numbers beside those found here.

One module a part; each has ``compute(quick, folder, say)``, which returns what it found as plain numbers and lists,
``draw(found)``, which makes figures from that alone, and ``rows(found)``, lines of the table. `run` does them all.

References
----------
L. M. Miller, T. D. Murphey, Simultaneous optimal estimation of mode transition times and parameters applied to simple
traction models.
"""

from switchfit.paper.runner import PARTS, run

__all__ = ["PARTS", "run"]
