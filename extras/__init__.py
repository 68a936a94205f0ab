"""Bonuses and rules for β beside the method, loaded as a user's own: docs/extending.md."""
