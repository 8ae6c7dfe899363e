"""Trained emissions as plain NumPy."""
