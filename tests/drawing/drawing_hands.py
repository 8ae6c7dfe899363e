"""Hands that draw."""

import numpy as np


def reach(number=0, duration=0.8):
    """A stroke that ends at (20, -30): samples (t, x, y) of a hand, unevenly spaced."""
    rng = np.random.default_rng(number)
    t = np.sort(np.r_[0.0, rng.uniform(0, duration, 60), duration])
    s = (t / duration) ** 2 * (3 - 2 * t / duration)
    return np.column_stack([t, 20 - 45 * np.sin(np.pi * s) * (1 - s), 35 - 65 * s + number])


def ellipse(rounds=2.5, period=0.8, way=1, begin=0.0):
    """A stroke round an ellipse of half axes 30 and 20 mm, sampled at 60 Hz."""
    t = np.arange(0, rounds * period, 1 / 60)
    angle = begin + way * 2 * np.pi * t / period
    return np.column_stack([t, 30 * np.cos(angle), 20 * np.sin(angle)])
