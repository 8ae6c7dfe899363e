"""The exported policy in a loop at 1 kHz: how late each tick comes, and what a command takes.

    python benchmarks/control_loop.py [--seconds 60] [--rate 1000] [--spin-us 200] [--realtime]

ONNX Runtime with the exported step alone, with its velocity, and `ImitationFlow.step` in NumPy,
each in a loop with absolute deadlines: tick k is due at start + k / rate, whatever came before it.
A loop sleeps until ``spin-us`` before a tick and then asks the clock until the tick is due. Garbage
collection waits until the end. ``--realtime`` asks Linux for SCHED_FIFO, which needs the right to
do so, and says when it is refused.

Printed for each way: the *jitter*, how late a tick begins; what a *command* takes; and the share of
ticks whose command was not ready when the next one was due. The percentiles are of all ticks but
the first 100. Run it on a machine that does nothing else: every other process is part of what it
measures.
"""

import gc
import json
import os
import platform
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray

from iflow_gym import load_lasa
from iflow_gym.baselines.imitation_flow import ImitationFlow

WARM_UP = 100
"""Ticks that do not count: caches and allocators fill."""
PERCENTILES = (50.0, 99.0, 99.9, 100.0)

Step = Callable[[NDArray[np.float64]], NDArray[np.float64]]


@dataclass(frozen=True)
class Options:
    """What to measure."""

    seconds: float = 60.0
    """How long each loop runs."""
    rate: float = 1000.0
    """Ticks a second."""
    spin_us: float = 200.0
    """How long before a tick the loop stops sleeping and looks at the clock."""
    shape: str = "Sshape"
    """LASA shape of the policy."""
    n_steps: int = 300
    """Training steps: they change the weights, and not what a step takes."""
    realtime: bool = False
    """Whether to ask for SCHED_FIFO."""
    json: Path | None = None
    """Where to write the numbers, too."""


@dataclass(frozen=True)
class Ticks:
    """What happened in a loop; arrays of shape (n,), in seconds."""

    late: NDArray[np.float64]
    """How long after it was due a tick began."""
    took: NDArray[np.float64]
    """How long its command took."""
    period: float

    @property
    def missed(self) -> float:
        """Share of the ticks whose command was not ready when the next one was due."""
        return float((self.late + self.took > self.period).mean())

    def counted(self) -> "Ticks":
        """Return the ticks after the warm-up."""
        return Ticks(self.late[WARM_UP:], self.took[WARM_UP:], self.period)

    def summary(self) -> dict[str, float]:
        """Return percentiles in microseconds, and the share that was missed."""
        found = {}
        for name, values in (("jitter", self.late), ("command", self.took)):
            for q, value in zip(PERCENTILES, np.percentile(values, PERCENTILES), strict=True):
                found[f"{name}_p{q:g}_us"] = float(value * 1e6)
        return found | {"missed": self.missed, "ticks": len(self.late)}


def run(
    step: Step,
    starts: NDArray[np.float64],
    n_ticks: int,
    period: float,
    spin: float,
    clock: Callable[[], float] = time.perf_counter,
    sleep: Callable[[float], None] = time.sleep,
) -> Ticks:
    """Run a loop: each state is what the step made of the last one.

    Where the motion is over, after as many ticks as a recording lasts, the next start follows.
    """
    late, took = np.empty(n_ticks), np.empty(n_ticks)
    x, each = starts[0], max(1, n_ticks // (4 * len(starts)))
    begin = clock() + period
    for k in range(n_ticks):
        due = begin + k * period
        if (left := due - clock() - spin) > 0:
            sleep(left)
        while (now := clock()) < due:
            pass
        x = step(x) if k % each else step(starts[k // each % len(starts)])
        late[k], took[k] = now - due, clock() - now
    return Ticks(late, took, period)


def ways(system: ImitationFlow, dt: float) -> dict[str, Step]:
    """Return ways to take a step of one state."""
    import onnxruntime

    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads = settings.inter_op_num_threads = 1
    times = np.array([dt])
    found: dict[str, Step] = {}
    for name, velocity in (("ONNX Runtime", False), ("ONNX Runtime, with velocity", True)):
        with tempfile.TemporaryDirectory() as folder:
            content = system.export(Path(folder) / "step.onnx", velocity=velocity).read_bytes()
        session = onnxruntime.InferenceSession(content, settings)
        names = [output.name for output in session.get_outputs()]
        found[name] = lambda x, run=session.run, names=names: run(
            names, {"x": x[None], "dt": times}
        )[names.index("x_next")][0]
    return found | {"NumPy": lambda x: system.step(x, dt)}


def ask_for_realtime() -> str:
    """Ask for SCHED_FIFO and return what became of it."""
    if not hasattr(os, "sched_setscheduler"):
        return "not on this system"
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(80))
    except PermissionError:
        return "refused: needs CAP_SYS_NICE"
    return "SCHED_FIFO, priority 80"


def main() -> None:
    """Print a table."""
    options = tyro.cli(Options, description=__doc__)
    motion = load_lasa(options.shape)
    system = ImitationFlow(n_steps=options.n_steps).fit(motion, seed=0)
    period, n_ticks = 1 / options.rate, WARM_UP + round(options.seconds * options.rate)
    scheduler = ask_for_realtime() if options.realtime else "the default"
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    machine = {
        "machine": f"{platform.system()} {platform.release()}, {platform.machine()}",
        "cores": os.cpu_count(),
        "load_before": load,
        "scheduler": scheduler,
    }
    print(", ".join(f"{key}: {value}" for key, value in machine.items()))
    head = " ".join(f"{f'p{q:g}':>8}" for q in PERCENTILES)
    print(f"{'':28} jitter, µs: {head}   command, µs: {head} {'missed':>9}")
    results = {}
    for name, step in ways(system, period).items():
        gc.collect()
        gc.disable()
        ticks = run(step, motion.starts, n_ticks, period, options.spin_us * 1e-6).counted()
        gc.enable()
        results[name] = found = ticks.summary()
        jitter, command = (
            " ".join(f"{found[f'{part}_p{q:g}_us']:8.1f}" for q in PERCENTILES)
            for part in ("jitter", "command")
        )
        print(f"{name:28} {'':11} {jitter} {'':14} {command} {found['missed']:9.4%}")
    if options.json is not None:
        options.json.write_text(json.dumps({"machine": machine, "loops": results}, indent=2))


if __name__ == "__main__":
    main()
