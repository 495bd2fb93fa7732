"""Results for people: text, tables and figures. Results do not know this room.

Its modules register how each kind of result is written and drawn (`switchfit.runtime.presentation`). All of them are
imported together, when a result is first written or drawn. Imports `online` and the rooms before it.
"""

from switchfit.report import batch, frames, html, modes, plot, sentences, text, uncertainty, validation  # noqa: F401
