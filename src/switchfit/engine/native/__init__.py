"""The discretized system and its derivatives in machine code.

JAX traces and differentiates the user's functions; `tracing` translates the result to expression graphs (`scalars`),
`templates` holds them, `kernels` inserts them into the shared rows and nodes, `loops` calls these, `program` says which
functions there are, `llvm` compiles them, and `program_cache` keeps them. `native_experiment` calls the machine code.
"""
