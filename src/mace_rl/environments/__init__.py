"""Environments, and acting in them."""
