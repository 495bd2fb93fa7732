"""Branches of a mode: the smooth functions that it is on given sides of its corners, sliding included.

On a surface that attracts from both sides the trajectory slides along it. With side 0 the branch is the convex
combination that stays on the surface (Filippov, 1988): with f_0 the field where all sliding corners have the side -1,
and f_k the same with the side +1 at corner k,

    ``f = f_0 + sum_k s_k (f_k - f_0)``,  ``dg_k/dt = D_t g_k + D_x g_k . f + D_u g_k . du/dt = 0``,

for all sliding corners k, which is left where s_k leaves [0, 1]. So a branch takes the input u with its rate, (2, ...).

A field may be undefined beyond a corner, as ``sqrt(maximum(x, 0))`` is on the side +1 where x < 0, with an infinite
slope at the corner. Such a corner is *steep*: nearer to it than a small *margin*, and beyond it, the field of a side is
that at the margin.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from functools import lru_cache
from itertools import product

import jax
import jax.numpy as jnp

from switchfit.arrays import Traced
from switchfit.problem.corners.walk import CornerWalk, has_corners, join_entries
from switchfit.problem.functions import Function, use_float64

Array = jax.Array

Sides = tuple[int, ...]
"""Side of each corner of a mode: +1, -1, or 0 where the trajectory slides."""

Margins = tuple[tuple[tuple[int, int], float], ...]
"""Corners that are steep with the side on which they are, and the |g| of their margins."""

SMALLEST_DISTANCE_BEYOND = 1e-8
"""Smallest |g| at which a field is evaluated beyond a corner."""

TOUCHED = 1e-12
"""|g| at which an output is evaluated at a corner."""


class Corners:
    """The corners of a mode, and its branches.

    Attributes
    ----------
    function : Function
        The mode.
    margins : Margins
    count : int
    lines : list of str
        File and line of the user's code that makes each of them.
    """

    def __init__(self, function: Function, margins: Margins = ()) -> None:
        self.function, self.margins = function, margins
        walks = [CornerWalk(())]
        # Smooth modes, the common case, are not walked through: only their primitives are looked at.
        if has_corners(function.jaxpr):
            with use_float64():
                jax.eval_shape(lambda *given: walks.append(self._run(None, given)[0]), *function.structs)
        lines, pairs = walks[-1].lines, walks[-1].pairs
        # Corners are the same where they compare the same two numbers, in either order.
        known: dict[tuple[int, ...], int] = {}
        self._group = [known.setdefault(tuple(sorted(pair)), len(known)) for pair in pairs]
        # Case: ``where(x > y, ...)`` and ``maximum(y, x)`` in one mode. Both change at x = y; as two corners they
        # would be met at one time, and have sides that no state is on: above one and below the other.
        firsts = [self._group.index(k) for k in range(len(known))]
        self._orientation = [1 if pair == pairs[firsts[k]] else -1 for pair, k in zip(pairs, self._group, strict=True)]
        self.count = len(known)
        self.lines = [lines[k] for k in firsts]
        self._firsts = firsts
        self._derived: dict[tuple[Hashable, Sides], Function] = {}

    def branch(self, sides: Sides) -> Function:
        """Return the mode with these sides."""
        if not self.count:
            return self.function
        return self._derive("branch", sides, lambda *given: self._field(sides, given)[0])

    def surfaces(self, sides: Sides) -> Function:
        """Return the functions g of all corners, (count,), with these sides."""
        sides = _settle(sides)
        return self._derive("surfaces", sides, lambda *given: jnp.stack(self._evaluate(sides, given)[1]))

    def rates(self, sides: Sides) -> Function:
        """Return dg/dt of all corners along a branch, (count,)."""
        return self._derive("rates", sides, lambda *given: self._rates(sides, self._field(sides, given)[0], given))

    def rates_at(self, sides: Sides, corner: int) -> Function:
        """Return what `rates` does at a steep corner, on its margin, at the point that is the nearest to the given."""
        margin = max(margin for (k, _), margin in self.margins if k == corner)

        def evaluate(t: Array, x: Array, *others: Array) -> Array:
            given = [t, self._move(sides, corner, sides[corner] * margin, [t, x, *others]), *others]
            return self._rates(sides, self._field(sides, given)[0], given)

        return self._derive(("rates_at", corner), sides, evaluate)

    def onto(self, sides: Sides, corner: int) -> Function:
        """Return the point of a corner that is the nearest to the given one, to first order: (n,)."""
        return self._derive(("onto", corner), sides, lambda *given: self._move(sides, corner, 0.0, given))

    def beyond(self, sides: Sides, corner: int) -> Function:
        """Return the field of a branch, (n,), at a point beyond one of its corners that is near to the given one."""

        def evaluate(t: Array, x: Array, *others: Array) -> Array:
            given = [t, x, *others]
            g = self.surfaces(sides).evaluate(given)[corner]
            there = self._move(sides, corner, -sides[corner] * (abs(g) + SMALLEST_DISTANCE_BEYOND), given)
            return self._field(sides, [t, there, *others])[0]

        return self._derive(("beyond", corner), sides, evaluate)

    def list_ends(self, sides: Sides) -> list[tuple[int, int]]:
        """Return the corner at each end of a branch, and its side behind the end.

        The function of an end, of (t, x, p), is positive inside and zero at the end.
        """
        return [(k, behind) for k, side in enumerate(sides) for behind in ((-side,) if side else (-1, 1))]

    def ends(self, sides: Sides) -> Function:
        """Return the functions of all ends of a branch, (ends,)."""
        return self._derive("ends", sides, lambda *given: jnp.stack(self._ends(sides, given)))

    def end(self, sides: Sides, which: int) -> Function:
        """Return the function of one of the ends of a branch, ()."""
        return self._derive(("end", which), sides, lambda *given: self._ends(sides, given)[which])

    def _derive(self, what: Hashable, sides: Sides, evaluate: Callable[..., Traced]) -> Function:
        # Each is a `Function`, traced once and compared by content, so that compiled programs find it by its digest.
        key = what, sides
        if key not in self._derived:
            with use_float64():
                self._derived[key] = self.function.derive(evaluate)
        return self._derived[key]

    def _run(self, sides: Sequence[int] | None, given: Sequence[Array]) -> tuple[CornerWalk, Array]:
        walk, function = CornerWalk(sides), self.function
        with use_float64():
            arguments = [walk.argument(k, value) for k, value in enumerate(given)]  # the state comes after t
            results = walk.run(function.jaxpr, function.consts, arguments)
        return walk, jnp.asarray(join_entries(results[0].value))

    def _evaluate(self, sides: Sides, given: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Return f (n,), and g of each corner."""
        # Members of a group compare the same two numbers, maybe in the other order: `o` is -1 then.
        # Case: play, ``maximum(x - c, 0) - maximum(-x - c, 0)``; a member of a group whose order is reversed has the
        # other side of the same surface.
        members = [o * sides[g] for g, o in zip(self._group, self._orientation, strict=True)]
        t, x, *others = given
        own = [others[0][0], *others[1:]] if self.function.takes_input else others  # of u and du/dt, the mode takes u
        walk, f = self._run(members, [t, x, *own])
        return f, [a - b for a, b in (walk.values[k] for k in self._firsts)]

    def _field(self, sides: Sides, given: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Return the field of a branch (n,), and s of its sliding corners."""
        sliding, (f, *others) = self._slide(sides, given)
        if not sliding:
            return f, []
        # dg_i/dt is linear in f, so that dg/dt = 0 along f_0 + sum_k s_k (f_k - f_0) is A s = -rate_0 with
        # A_ij = rate_j,i - rate_0,i.
        rate = [self._rates(_settle(sides), field, given)[jnp.array(sliding)] for field in (f, *others)]
        # Friction on a body that sticks: one corner, and A is a number. Two relays at once, as the axles of a vehicle
        # that both stick, are coupled by its mass: a system of two.
        A = [[rate[1 + j][i] - rate[0][i] for j in range(len(sliding))] for i in range(len(sliding))]
        s = _solve(A, [-rate[0][i] for i in range(len(sliding))])
        return f + sum(each * (other - f) for each, other in zip(s, others, strict=True)), s

    def _slide(self, sides: Sides, given: Sequence[Array]) -> tuple[list[int], list[Array]]:
        """Return the sliding corners; f_0 with side -1 at all of them, and f_k with side +1 at one of them alone."""
        # Sliding along all corners with side 0. The fields with one of them at +1 span the combination (Filippov);
        # those with several at +1 are not needed while it is linear in each s.
        sliding, base = [k for k, side in enumerate(sides) if side == 0], _settle(sides)
        every = base, *((*base[:k], 1, *base[k + 1 :]) for k in sliding)
        return sliding, [self._guard(each).evaluate(given) for each in every]

    def returns(self, sides: Sides) -> Function:
        """Return what is left of a small displacement from a branch that slides once the trajectory is back: (n, n).

        Of x it is ``x - sum_k c_k (f_k - f_0)``, with c such that D_x g of the sliding corners along it is zero.
        """

        def evaluate(t: Array, x: Array, *others: Array) -> Array:
            sliding, (f, *fields) = self._slide(sides, [t, x, *others])
            g_x = jax.jacfwd(lambda x: self.surfaces(sides).evaluate([t, x, *others]))(x)
            A = [[g_x[i] @ (field - f) for field in fields] for i in sliding]
            c = _solve(A, [g_x[i] for i in sliding])
            return jnp.eye(len(x)) - sum(jnp.outer(field - f, each) for field, each in zip(fields, c, strict=True))

        return self._derive("returns", sides, evaluate)

    def _guard(self, sides: Sides) -> Function:
        """Return the mode with these sides, at steep corners no nearer than their margins: traced once for all uses."""

        def evaluate(t: Array, x: Array, *others: Array) -> Array:
            # Steep corner, as of a tank that runs dry, ``sqrt(maximum(h, 0))``: its slope is infinite at h = 0, where
            # the last stages of a row stand. There the field of the wet side is that at h = margin, whose slopes are
            # finite.
            for (k, side), margin in self.margins:
                if sides[k] == side:
                    is_near = side * self.surfaces(sides).evaluate([t, x, *others])[k] < margin
                    x = jnp.where(is_near, self._move(sides, k, side * margin, [t, x, *others]), x)
            return self._evaluate(sides, [t, x, *others])[0]

        return self._derive("guard", sides, evaluate)

    def _move(self, sides: Sides, corner: int, target: Array | float, given: Sequence[Array]) -> Array:
        """Return the state nearest to x at which g of a corner is the target, to first order in g: (n,)."""
        t, x, *others = given
        g, gradient = jax.value_and_grad(lambda x: self.surfaces(sides).evaluate([t, x, *others])[corner])(x)
        # A surface whose gradient is 0 here, as x**2 = 0 has: there is no nearest point to first order, and x stays.
        square = jnp.sum(gradient**2)
        return x - (g - target) * gradient / jnp.where(square > 0, square, 1.0)

    def _rates(self, sides: Sides, f: Array, given: Sequence[Array]) -> Array:
        """Return D_t g + D_x g . f + D_u g . du/dt of all corners: (count,)."""
        t, x, *others = given
        moving, rates = [t, x], [jnp.ones_like(t), f]
        if self.function.takes_input:
            u, *others = others
            moving, rates = [*moving, u], [*rates, jnp.stack([u[1], jnp.zeros_like(u[1])])]
        # The derivative of g along (1, f, du/dt): one forward pass.
        # Of the input, the second row is its rate du/dt, which does not move along itself: cubic inputs bend inside a
        # row, but dg/dt is asked for at one time.
        surfaces = lambda *moving: self.surfaces(sides).evaluate([*moving, *others])  # noqa: E731
        return jax.jvp(surfaces, moving, rates)[1]

    def _ends(self, sides: Sides, given: Sequence[Array]) -> list[Array]:
        g = self.surfaces(sides).evaluate(given)
        s = iter(self._field(sides, given)[1])
        # Of a corner with a side: side g, positive inside. Of a sliding one: s and 1 - s, the limits of the convex
        # combination.
        # A sliding corner has two ends, one for each side on which it may be left. Their order is that of `list_ends`.
        ends = [[side * g[k]] if side else [each := next(s), 1.0 - each] for k, side in enumerate(sides)]
        return [value for each in ends for value in each]

    def choose(self, t: Array, x: Array, *others: Array) -> Array:
        """Return the function on the sides on which x is: others are evaluated where they are defined, and left out."""
        g, chosen = self._evaluate((1,) * self.count, [t, x, *others])[1], jnp.zeros(self.function.shape)
        for sides in product((1, -1), repeat=self.count):
            # All branches are evaluated, as JAX has no branch under `vmap`; those that are not chosen must be finite.
            # So each is evaluated at the nearest point of its own sides, a little inside.
            is_here, there = jnp.array(True), x
            for k, side in enumerate(sides):
                is_inside, target = side * g[k] > 0, side * (abs(g[k]) + TOUCHED)
                there = jnp.where(is_inside, there, self._move(sides, k, target, [t, there, *others]))
                is_here &= (g[k] > 0) == (side > 0)
            chosen = jnp.where(is_here, self._evaluate(sides, [t, there, *others])[0], chosen)
        return chosen


def _settle(sides: Sides) -> Sides:
    """Return sides with -1 for those that slide."""
    return tuple(side or -1 for side in sides)


# By hand and not by `jnp.linalg.solve`: machine code compiles straight-line operations, and few corners slide
# at once.
def _solve(A: list[list[Array]], b: list[Array]) -> list[Array]:
    """Solve linear equations by elimination, without pivoting: A_kk < 0 where corner k attracts from both sides."""
    (pivot, *right), *rest = A
    parts = [row[0] / pivot for row in rest]
    inner = [[a - part * c for a, c in zip(row[1:], right, strict=True)] for row, part in zip(rest, parts, strict=True)]
    others = _solve(inner, [each - part * b[0] for each, part in zip(b[1:], parts, strict=True)]) if rest else []
    return [(b[0] - sum(c * s for c, s in zip(right, others, strict=True))) / pivot, *others]


@lru_cache(maxsize=256)
def find_corners(function: Function, margins: Margins = ()) -> Corners:
    """Return the corners of a mode, some of them steep, found once."""
    return Corners(function, margins)
