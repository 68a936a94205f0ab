"""One run to its metrics."""
