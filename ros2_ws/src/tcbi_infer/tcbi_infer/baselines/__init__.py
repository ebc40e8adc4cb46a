"""What TCBI is compared with: other methods on the same rollouts, the same batch engine and the same budget.

Each module is one method: settings, a state, `init`, a pure `step(rng, state, simulate, real, settings)` and
`posterior(state)`; `tcbi_infer.tcbi.method` lists them. Particles live in probit space, where the flat prior is a
standard normal.
"""
