"""Reinforcement learning of residuals with Stable-Baselines3: what `baselines/residual.py` runs."""
