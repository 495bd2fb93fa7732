"""The exception of functions that have no scalar form: it says what they do, and where."""

from __future__ import annotations


class Unsupported(Exception):  # noqa: N818  # control flow, not an error: the caller falls back to JAX
    """A function that cannot be written as a straight line of scalars.

    Attributes
    ----------
    what : str
        What it does, as the rest of a sentence that begins with the function: "calls jnp.sort".
    where : str or None
        File and line of the user's code, if known.
    """

    def __init__(self, what: str, where: str | None = None) -> None:
        super().__init__(what, where)
        self.what, self.where = what, where

    def __str__(self) -> str:
        return self.what if self.where is None else f"{self.what} ({self.where})"


def check_size(count: int, most: int, what: str) -> None:
    """Refuse what would take too many operations, or too much memory."""
    if count > most:
        raise Unsupported(f"{what} (limit: {most})")
