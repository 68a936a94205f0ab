"""The method: read `trainer.py` first."""
