"""Estimation problems: what users give, the functions traced, and the vector theta of all unknowns.

What users give: `system`, `parameter` and `priors`, `experiment` with its data (`measurements`, `reference_signals`,
`costs`) and `inputs`, all checked by `validation`; together they are a `problem`. What is made of it: the `unknowns` in
theta, and for each experiment a `structure` of traced `functions`. Imports `runtime`, and of `optimize` the linear
constraints; it is independent of meshes and integrators.
"""
