"""How fast the project is, next to stable-baselines3, and where the time goes: `make bench`.

A measurement, not a test: nothing here passes or fails. docs/performance.md explains it. Each
module measures one thing and writes its CSV file; `report` makes tables and pictures of them.
"""

import mace_rl  # noqa: F401  (before any of them imports NumPy: equal bits on every processor)
