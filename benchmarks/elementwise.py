"""A batch of LWR, GPR and BC with torch's exp2 and sigmoid, and with NumPy's: medians in one run.

    OMP_NUM_THREADS=1 python benchmarks/elementwise.py [--n-states 263]

Which is faster depends on the processor: NumPy's exp2 and tanh of doubles use AVX-512, and without
it no vector instructions. Velocities by both are compared, too.
"""

import statistics
import time
from dataclasses import dataclass
from unittest.mock import patch

import numpy as np
import tyro

from iflow_gym import load_lasa
from iflow_gym.baselines import behavioural_cloning as bc
from iflow_gym.baselines import gpr, lwr
from iflow_gym.demonstrations import FloatArray


@dataclass(frozen=True)
class Options:
    """What to measure."""

    n_states: int = 263
    """States of a batch; 263 are what a shape's stability is scored with."""
    repeats: int = 200
    """Timings of each, in turn; the median is reported."""


def exp2_by_numpy(values: FloatArray) -> FloatArray:
    """As `elementwise.exp2_`."""
    return np.exp2(values, out=values)


def sigmoid_by_numpy(values: FloatArray, biases: FloatArray) -> FloatArray:
    """As `behavioural_cloning._sigmoid`, by the tanh that it is."""
    values += biases
    values *= 0.5
    np.tanh(values, out=values)
    values += 1
    values *= 0.5
    return values


def main(options: Options) -> None:
    """Measure and print."""
    motion = load_lasa("Angle")
    rng = np.random.default_rng(0)
    low, high = motion.bounding_box
    states = rng.uniform(low, high, size=(options.n_states, motion.n_dims))
    print(f"{options.n_states} states{'':13}torch us   NumPy us   ratio   difference")
    for module, system, name, function in (
        (lwr, lwr.LWR(), "exp2_", exp2_by_numpy),
        (gpr, gpr.GPR(), "exp2_", exp2_by_numpy),
        (bc, bc.BehaviouralCloning(n_steps=100), "_sigmoid", sigmoid_by_numpy),
    ):
        fitted = system.fit(motion, seed=0)
        seconds: tuple[list[float], list[float]] = ([], [])
        found = []
        for _ in range(options.repeats):
            for k, own in enumerate((getattr(module, name), function)):
                with patch.object(module, name, own):
                    began = time.perf_counter()
                    velocity = fitted.velocity(states)
                    seconds[k].append(time.perf_counter() - began)
                found.append(velocity)
        torchs, theirs = (1e6 * statistics.median(s) for s in seconds)
        apart = np.abs(found[0] - found[1]).max() / np.abs(found[1]).max()
        print(
            f"{fitted.title:22} {torchs:9.0f}  {theirs:9.0f}   {torchs / theirs:5.2f}   {apart:.1e}"
        )


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
