"""Print a recording as a hand and a tablet make it: `python docs/hand_drawn.py > reach.csv`.

Three times the same motion, in millimetres, sampled when the operating system finds the time: a
still start, a still end, samples that scatter, and one that was lost. Made by a fixed seed.
"""

import sys

import numpy as np

NAMES = ("t", "demo", "x (mm)", "y (mm)")

SCATTER = 0.15
"""Standard deviation of a sample, mm."""


def recordings(seed: int = 0, n: int = 3):
    """Yield the table of each recording: time in s, its number, x and y in mm."""
    rng = np.random.default_rng(seed)
    for number in range(1, n + 1):
        still, moving, after = 0.4 + 0.2 * rng.random(), 1.8 + 0.4 * rng.random(), 0.3
        t = np.cumsum(rng.uniform(0.004, 0.02, size=400))
        t = t[t < still + moving + after]
        s = np.clip((t - still) / moving, 0, 1)
        s = s**3 * (10 - 15 * s + 6 * s**2)  # least jerk: from rest to rest
        wobble = 3 * rng.normal(size=(2, 2))
        x = 180 * (1 - s) + wobble[0, 0] * np.sin(np.pi * s) + wobble[0, 1] * np.sin(2 * np.pi * s)
        y = 70 * np.sin(1.5 * np.pi * s) * (1 - 0.3 * s) + 49 * s
        y += wobble[1, 0] * np.sin(np.pi * s) + wobble[1, 1] * np.sin(2 * np.pi * s)
        points = np.stack([x, y], axis=1) + rng.normal(0, SCATTER, size=(len(t), 2))
        yield np.column_stack([t, np.full(len(t), number), points])


def main() -> None:
    """Print the table."""
    table = np.vstack(list(recordings()))
    table[137, 2:] = np.nan
    print(",".join(NAMES))
    for t, number, x, y in table:
        print(f"{t:.4f},{number:.0f},{x:.3f},{y:.3f}")


if __name__ == "__main__":
    sys.exit(main())
