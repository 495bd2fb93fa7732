"""The discretised system and its derivatives in machine code of its own: what evaluates a single fit.

JAX traces and differentiates the user's functions; `trace` writes what comes out as scalars (`scalars`), `templates`
holds them, `kernels` puts them into the shared rows and nodes, `driver` loops over these, `llvm` compiles, `program`
keeps, and `experiment` runs. What `trace` needs for decisions at run time stands in `entries` (choices), `integers`,
`indexing`, `sorting` and `matrices`.
"""
