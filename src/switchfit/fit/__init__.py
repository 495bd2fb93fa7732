"""One fit: evaluator in, result out.

`minimization` is one run of the optimizer, with `change_of_variables`, `collapsed_modes` and `hidden_switches`;
`termination` says how it ended, and `result` has its numbers. `trajectory` and `comparison` show it beside the data.
Imports `meshes` and the rooms before it.
"""
