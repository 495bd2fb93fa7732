"""The one setting of XLA's that switchfit needs: small loops compiled into one kernel.

An evaluation is a few loops over the rows of a mesh, each with little work in it. By default XLA's CPU backend runs a
loop kernel by kernel; compiled as a whole an evaluation takes 0.5 to 0.65 of the time, and compiles sooner. The
setting can only be given to XLA before it starts and holds for all programs of the process. The limit therefore is
1 MB: loops over arrays so small gain nothing from more threads.
"""

from __future__ import annotations

import os

OPTION = "xla_backend_extra_options"
SMALL_LOOPS = f"--{OPTION}=xla_cpu_small_while_loop_byte_threshold=1000000"


def compile_small_loops_whole() -> None:
    """Add the setting to the environment variable XLA_FLAGS, unless the user has given that option himself.

    Without effect where JAX has run something before switchfit is imported; results are the same then, only later.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if OPTION not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {SMALL_LOOPS}".strip()
