"""Modes with corners: a trajectory crosses them from branch to branch, and each crossing is a transition.

`branches` is the library of branches that trajectories have run in, `course` follows a trajectory through them while an
adaptive solver runs, `adaptive.step_times` repeats the solve until the whole path is known, and `split_engine`
evaluates the experiment with the times of the crossings eliminated. Corners are found in traced functions by
`problem.corners`.
"""
