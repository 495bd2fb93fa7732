"""Loops in hand-written LLVM IR, which call the straight-line functions of `switchfit.engine.native.kernels`.

`segments` goes through the rows of a segment forward and backward, `sample_loops` through the samples, `driver` through
the whole horizon; `adaptive_steps` solves a mode adaptively; `xla_handler` is the entry for XLA.
"""
