"""The discretised system and its derivatives in machine code of its own: what evaluates a single fit.

JAX traces and differentiates the user's functions; `trace` writes what comes out as scalars (`scalars`), `kernels`
puts them into Runge-Kutta steps, `llvm` compiles, and `program` drives. What `trace` needs for decisions at run time stands in
`entries` (choices), `integers`, `indexing`, `sorting` and `matrices`. Everything here has its counterpart in
`switchfit.discretization.propagation` and `switchfit.engine.jax`, which do the same in JAX, for batches and
accelerators and for what has no scalar form.
"""
