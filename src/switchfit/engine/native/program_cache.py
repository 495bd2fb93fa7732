"""Compile and cache programs: a library of modes is compiled once a process, or has a reason why it cannot be.

Functions that cannot be written as straight-line code have no machine code. Any other failure is a defect of this
package: the caller falls back to JAX as well, and the reason begins with "internal: ".
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from functools import lru_cache
from itertools import chain

from switchfit.engine.native.layout import layout_of
from switchfit.engine.native.llvm.compilation import Program, compile_modules
from switchfit.engine.native.llvm.module import Module
from switchfit.engine.native.sizes import Order, Sizes
from switchfit.engine.native.tracing.unsupported import Unsupported
from switchfit.problem.functions import use_float64
from switchfit.problem.structure import Structure

_one_at_a_time = threading.Lock()
log = logging.getLogger("switchfit")

ORDER_PREFIXES = {
    Order.COST: "plain_",
    Order.GRADIENT: "first_",
    Order.HESSIAN: "",
    Order.GAUSS_NEWTON: "gauss_newton_",
}
"""Prefix of the names of functions, by the order of their derivatives."""

Write = Callable[[Structure, Sizes, Order, Module], Iterator[str]]
"""Writes functions of a library with derivatives of an order, in parts."""


def compile_library(library: Structure, sizes: Sizes, orders: tuple[Order, ...], write: Write) -> Program | str:
    """Return the machine code that a function writes, or the reason why there is none, as `program_of` does.

    The log has the reason too.
    """
    with _one_at_a_time:
        return _program_of(library, sizes, orders, write)


# The key is all that the code depends on: the library, whose functions are compared by content, the sizes, the orders,
# and who writes it. Mode sequences, data and meshes are arguments of the machine code.
@lru_cache(maxsize=64)
def _program_of(library: Structure, sizes: Sizes, orders: tuple[Order, ...], write: Write) -> Program | str:
    modules = {order: Module(sizes.width, ORDER_PREFIXES[order]) for order in orders}
    try:
        # A vector without entries is no type of LLVM.
        if sizes.D == 0:
            raise Unsupported("an experiment has no unknowns")
        with use_float64():
            # A generator: one part is compiled while the next one is traced.
            parts = (write(library, sizes, order, each) for order, each in modules.items())
            program = compile_modules(chain.from_iterable(parts))
    except Unsupported as error:
        reason = str(error)
        log.info("No machine code: %s.", reason)
    # Whatever went wrong, JAX can evaluate the problem; tests look for reasons that begin with `internal: `.
    except Exception as error:
        reason = f"internal: {type(error).__name__}: {error}"
        log.info("No machine code: %s.", reason, exc_info=True)
    else:
        program.modules = modules
        return program
    return reason


def drop_programs() -> None:
    """Drop cached programs that are not in use, and what is known of their memory."""
    with _one_at_a_time:
        _program_of.cache_clear()
        layout_of.cache_clear()
