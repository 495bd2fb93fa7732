"""Corners of a mode: surfaces g(t, x, p) = 0 on which ``abs``, ``where``, ``maximum``... of a state change.

They are found in the traced function. With the *side* of each corner given (+1 where g > 0, -1 where g < 0), the mode
is a smooth function: its *branch*. `walk` evaluates a function with given sides and lists its corners, `branches` has
the corners of a mode and its branches, `outputs` writes an output as a choice among its branches, and `timed` has the
corners that follow from t, the input and fixed parameters alone: `times` finds when they are met, before anything runs.
"""
