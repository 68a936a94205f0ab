"""How fast the project is, beside stable-baselines3 and PureJaxRL: `make bench`.

Each module measures one thing; all their rows are in measurements.csv, and `page` makes README.md
of them. A measurement, not a test: no time makes anything fail.
"""
