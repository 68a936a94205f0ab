"""Data to tables, pages and pictures."""
