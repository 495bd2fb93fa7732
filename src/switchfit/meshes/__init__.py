"""The meshes of a problem: how they are made, used, followed, halved and judged.

`refinement` makes the mesh of an experiment by adaptive solves, with the `implicit_modes` that these show to be stiff.
An `evaluator` is a problem on such meshes: J and its exact derivatives as functions of theta alone, which a fit works
with. A `follower` makes the meshes anew as theta moves, where the errors of their rows are too large. `halving` makes
finer ones, by which `integration_error` judges at the end of a fit how much of J is integration error, and on which the
fit goes on if that is too much. Imports `runtime`, `problem`, `discretization`, `engine`, `paper_adjoint`, and of
`optimize` the shapes of matrices.
"""
