"""The discretized system and its derivatives in machine code, which evaluates single fits.

JAX traces and differentiates the user's functions; `trace` translates the result to expression graphs (`scalars`),
`templates` holds them, `kernels` inserts them into the shared rows and nodes, `program` loops over these and caches
what `llvm` compiles, and `engine` calls the machine code. `arrays` (selections, integers, indexing, sorting,
matrices) has the parts of `trace` that depend on values at run time.
"""
