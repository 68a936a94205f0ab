"""Seeds to means, intervals, tests and verdicts."""
