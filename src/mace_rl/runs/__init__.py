"""Runs on disk: train, resume, say where results come from, evaluate, verify."""
