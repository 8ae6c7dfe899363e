"""Time the Fréchet distance and DTW side by side with the package similaritymeasures.

Run with ``python benchmarks/metrics.py``; both sides run in turns in one process, on one thread.
Pairs of 1000 x 1000 samples: synthetic curves, and two
demonstrations of each of three LASA shapes. Results are compared as well as timed. Nothing here is
asserted in a test: the ratio is a property of the machine.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import statistics
import sys
import time
from collections.abc import Callable, Iterator

import numpy as np
import similaritymeasures
from numpy.typing import NDArray

from iflow_gym.datasets.lasa import load_lasa
from iflow_gym.metrics import dtw, frechet

Curve = NDArray[np.float64]
N_SAMPLES = 1000
REPEATS_OURS = 25
REPEATS_THEIRS = 5
LASA_SHAPES = ("Angle", "Sshape", "Sharpc")


def wiggly_curve(seed: int) -> Curve:
    """Return a curve of 1000 samples in the plane with ten random harmonics, in mm."""
    rng = np.random.default_rng(seed)
    s = np.linspace(0, 1, N_SAMPLES)[:, None]
    harmonics = np.arange(1, 11)
    waves = np.sin(2 * np.pi * s * harmonics + rng.uniform(0, 2 * np.pi, 10))
    return 40 * s + waves @ rng.normal(0, 10 / harmonics[:, None], (10, 2))


def pairs() -> Iterator[tuple[str, Curve, Curve]]:
    """Yield a name and two curves of 1000 samples, shape (1000, 2)."""
    yield "synthetic", wiggly_curve(0), wiggly_curve(1)
    for shape in LASA_SHAPES:
        first, second = load_lasa(shape).positions[:2]
        yield f"LASA {shape}", first, second


def milliseconds(function: Callable[[], object], repeats: int) -> float:
    """Median time of a call, in ms."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return 1000 * statistics.median(times)


def main() -> None:
    print(f"Python {sys.version.split()[0]}, NumPy {np.__version__}, ", end="")
    print(f"medians of {REPEATS_OURS} and {REPEATS_THEIRS} calls, {N_SAMPLES} x {N_SAMPLES}\n")
    print(f"{'pair':14} {'metric':8} {'iflow_gym':>12} {'similaritym.':>14} {'ratio':>7}")
    for name, x, y in pairs():
        sides: dict[str, tuple[Callable[[], float], Callable[[], float]]] = {
            "frechet": (
                lambda x=x, y=y: float(frechet(x, y)),
                lambda x=x, y=y: float(similaritymeasures.frechet_dist(x, y)),
            ),
            "dtw": (
                lambda x=x, y=y: float(dtw(x, y)),
                lambda x=x, y=y: float(similaritymeasures.dtw(x, y)[0]) / len(x),
            ),
        }
        for metric, (ours, theirs) in sides.items():
            np.testing.assert_allclose(ours(), theirs(), rtol=1e-9)
            fast, slow = milliseconds(ours, REPEATS_OURS), milliseconds(theirs, REPEATS_THEIRS)
            print(f"{name:14} {metric:8} {fast:9.2f} ms {slow:11.1f} ms {slow / fast:6.0f}x")
    x = np.stack([wiggly_curve(seed) for seed in range(7)])
    y = np.stack([wiggly_curve(100 + seed) for seed in range(7)])
    print("\nseven pairs in one call, ms a pair:")
    for metric, function in (("frechet", frechet), ("dtw", dtw)):
        batch = milliseconds(lambda function=function: function(x, y), 9) / len(x)
        print(f"{'batch of 7':14} {metric:8} {batch:9.2f} ms")


if __name__ == "__main__":
    main()
