"""How fast the project is, next to stable-baselines3, and where the time goes: `make bench`.

A measurement, not a test: nothing here passes or fails. docs/performance.md explains it.
"""
