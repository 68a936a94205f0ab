"""The bonus for agents of others, as Gymnasium wrappers."""
