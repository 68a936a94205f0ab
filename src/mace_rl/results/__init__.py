"""From the records of runs to metrics, tables and figures."""
