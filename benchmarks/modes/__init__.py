"""How often a search over mode sequences finds the truth: ``python -m benchmarks modes``.

Simulated logs whose modes and times are known, and problems of the literature. Each set of them is searched by
`switchfit.find_modes`, which is told the library of modes and nothing of the sequence; some sets by other libraries too
(`benchmarks.modes.peers`), which are told more.
"""
