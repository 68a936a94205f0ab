"""The report: one page with a study's verdicts, tables, figures, animations, costs and settings."""
