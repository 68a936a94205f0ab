"""Bonuses and rules for β that no study here uses, loaded as a user's own: docs/extending.md."""
