"""A study: its settings, what is measured on its runs, how they compare, and how that is shown."""
