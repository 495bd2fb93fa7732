"""The adaptive solve of one experiment, whose step times tell how many cells its mesh needs where.

`steps` takes single steps in machine code or by SciPy, `integrator` goes through all segments of an experiment with
them, `stiffness` watches whether stability limits them, and `step_times` is what the rooms above call.
"""
