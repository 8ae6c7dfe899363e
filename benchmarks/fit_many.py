"""Seconds and memory of `ImitationFlow.fit_many` against the number of models trained together.

    python benchmarks/fit_many.py [--counts 1 4 16 64] [--n-steps 320] [--device cuda]

Each count is trained in a process of its own, on LASA shapes and seeds in turn; memory is the rise
of the process's peak over what the imports take. Milliseconds a step are of the steps between a
quarter of them and all: both fits sweep for fast places as often, and are not trained on where they
are loud. Seconds are extrapolated to the default number of steps, without those. With a GPU,
`--device cuda` trains there; `--counts 150` is the 30 shapes with five seeds.
"""

import json
import resource
import subprocess
import sys
import time
from dataclasses import dataclass
from itertools import cycle, islice

import torch
import tyro

from iflow_gym.baselines.imitation_flow import ImitationFlow, training
from iflow_gym.baselines.imitation_flow.config import ENDS
from iflow_gym.datasets.lasa import MULTI_MODELS, SINGLE_MOTIONS, load_lasa


@dataclass(frozen=True)
class Options:
    """What to measure."""

    counts: tuple[int, ...] = (1, 4, 16, 64)
    """Models trained together."""
    n_steps: int = 320
    """Steps that are timed; a multiple of 160, so that a quarter has as many sweeps."""
    device: str = "cpu"
    """Where; "cuda" for a GPU."""
    one: bool = False
    """Measure the first count in this process and print JSON."""


def peak_mb() -> float:
    """Peak resident memory of this process."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def measure(count: int, n_steps: int, device: str) -> dict[str, float]:
    """Train `count` models and return milliseconds a step and the rise in memory."""
    torch.set_num_threads(1)
    training.CALM_ROUNDS = 0
    shapes = list(islice(cycle((*SINGLE_MOTIONS, *MULTI_MODELS)), count))
    motions, seeds = [load_lasa(s) for s in shapes], list(range(count))
    ImitationFlow(n_steps=2, device=device).fit(motions[0], seed=0)
    before = peak_mb()
    times = {}
    for steps in (n_steps // 4, n_steps):
        began = time.perf_counter()
        ImitationFlow(n_steps=steps, device=device).fit_many(motions, seeds=seeds)
        times[steps] = time.perf_counter() - began
    step = (times[n_steps] - times[n_steps // 4]) / (n_steps - n_steps // 4)
    memory = peak_mb() - before
    if device == "cuda":
        memory = torch.cuda.max_memory_allocated() / 2**20
    return {"step_ms": 1e3 * step, "memory_mb": memory}


def main() -> None:
    """Print a line a count."""
    options = tyro.cli(Options, description=__doc__)
    if options.n_steps % (4 * training.N_WATCHES) or options.n_steps < 1:
        sys.exit(f"Expected --n-steps as a multiple of {4 * training.N_WATCHES}.")
    if options.one:
        print(json.dumps(measure(options.counts[0], options.n_steps, options.device)))
        return
    print(f"{'models':>7} {'ms a step':>10} {'a model':>8} {'memory MB':>10} {'whole fit s':>12}")
    for count in options.counts:
        command = [sys.executable, __file__, "--one", "--counts", str(count)]
        command += ["--n-steps", str(options.n_steps), "--device", options.device]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        found = json.loads(done.stdout.splitlines()[-1])
        whole = found["step_ms"] * ENDS.n_steps / 1e3
        print(
            f"{count:7} {found['step_ms']:10.2f} {found['step_ms'] / count:8.3f} "
            f"{found['memory_mb']:10.0f} {whole:12.0f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
