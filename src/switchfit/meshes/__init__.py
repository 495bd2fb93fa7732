"""Meshes: making, following, halving and judging them; a problem on its meshes is an `evaluator`.

`refinement` makes the mesh of an experiment by adaptive solves, with the `implicit_modes` that these show; a `follower`
makes it anew as theta moves; `integration_error` says whether it is fine enough. Imports `runtime`, `problem`,
`discretization`, `engine`, `paper_adjoint`, and of `optimize` the shapes of matrices.
"""
