"""The making of the meta network's weights: `python -m tools.meta --help`."""
