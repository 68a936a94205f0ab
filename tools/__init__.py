"""The commands behind `make`, and those that docs name: python -m tools.NAME --help."""

import mace_rl.base.cpu_features  # noqa: F401  (before any tool imports NumPy: equal bits on every processor)
