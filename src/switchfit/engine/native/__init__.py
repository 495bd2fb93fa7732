"""The discretized system and its derivatives in machine code, which evaluates single fits.

JAX traces and differentiates the user's functions; `trace` translates the result to expression graphs (`scalars`),
`templates` holds them, `kernels` inserts them into the shared rows and nodes, `driver` loops over these, `llvm`
compiles, `program` caches, and `experiment` calls the machine code. `entries` (selections), `integers`, `indexing`,
`sorting` and `matrices` are the parts of `trace` that depend on values at run time.
"""
