"""The teacher: drums with the arm as a person's hand would, and records where the tip went.

    python -m iflow_gym.envs.drumming.teacher [drums.npz]

Its dimensions, rates and scatter are those of the recording that the ImitationFlow authors
published: two drums 0.275 m apart; over a high arch (0.22 m above the heads) to the right drum in
2.8 s, over a low one (0.09 m) back to the left in 2.25 s; 100 Hz, 10 s, begun near the top of the
high arch. Tempo and heights differ from recording to recording, strokes from round to round.

So are its turns: a person does not turn on the spot, but follows through. The recorded hand is
within 1 cm of its lowest point for 0.38 s on the right and for 0.30 s on the left, moving at
0.02 m/s there, and its way up is 4 mm beside its way down at that height. Here these are 0.32 and
0.31 s, 0.01 and 0.02 m/s, and 5 and 4 mm.

A stroke from one head to the other takes s from 0 to 1. Height is an arch with rounded ends,

    H (sqrt(sin(pi s)^2 + r^2) - r) / (sqrt(1 + r^2) - r).

Across, the hand first lifts and then goes over: the minimum-jerk polynomial
10 s^3 - 15 s^4 + 6 s^5. The lowest point wanted is 10 to 16 mm into a head, which gives way. The
hand's command is the velocity of this path plus a pull of 10/s towards it. What is stored is the
simulated tip.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from iflow_gym.datasets import drums as dataset
from iflow_gym.datasets.drums import DRUMS, TIP_RADIUS
from iflow_gym.demonstrations import FloatArray
from iflow_gym.envs.drumming.control import CONTROL_DT
from iflow_gym.envs.drumming.simulation import Simulation

SEED: Final = 2020
RECORDINGS: Final = 6
SAMPLES: Final = 1000

HIGH, LOW = 0, 1
DURATIONS: Final = (2.8, 2.25)
"""Of the high and the low stroke, in s."""
HEIGHTS: Final = (0.222, 0.088)
"""Of the high and the low arch over the heads, in m."""
BULGES: Final = (0.018, 0.006)
"""How far an arch swings outward at either end, in m."""
LEANS: Final = (-0.02, 0.005)
"""How far an arch leans forward at its top, in m."""
SPOTS: Final = ((0.672, -0.138), (0.690, 0.138))
"""Where the right and the left head are hit, x and y in m."""
ROUNDNESS: Final = (0.42, 0.19)
"""r at the ends of the high and the low arch."""
DEPTH: Final = 0.013
"""How far below first contact the hand aims, in m: it follows through."""
PULL: Final = 10.0
"""Of the hand towards its path, in 1/s."""
RUN_UP: Final = 0.5
"""Seconds that the hand moves before the recording begins."""


@dataclass(frozen=True)
class Stroke:
    """From one head to the other."""

    begin: float
    """In s."""
    duration: float
    kind: int
    """`HIGH` (to the right head) or `LOW` (to the left)."""
    start: FloatArray
    """Where it begins in m, shape (3,)."""
    end: FloatArray
    height: float
    lean: float

    def at(self, time: float) -> FloatArray:
        """Return the wanted position of the tip in m, shape (3,)."""
        s = (time - self.begin) / self.duration
        across = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
        point = self.start + across * (self.end - self.start)
        direction = np.sign(self.end[1] - self.start[1])
        point[0] += self.lean * np.sin(np.pi * s) ** 2
        point[1] -= direction * BULGES[self.kind] * np.sin(2 * np.pi * s)
        point[2] += self.height * _arch(s, ROUNDNESS[self.kind])
        return point


def _arch(s: float, r: float) -> float:
    """Return the height at s as a share of the arch's, r its roundness at the ends."""
    return float((np.hypot(np.sin(np.pi * s), r) - r) / (np.hypot(1.0, r) - r))


class Hand:
    """The path that the teacher wants in one recording."""

    def __init__(self, rng: np.random.Generator) -> None:
        pace = 1.0 + 0.015 * rng.standard_normal()
        size = 1.0 + 0.04 * rng.standard_normal()
        place = np.array([0.012, 0.006]) * rng.standard_normal(2)
        self._tremor = rng.uniform(0.0, 2 * np.pi, (4, 3)), rng.uniform(0.2, 1.6, (4, 3))
        self.strokes: list[Stroke] = []
        # The recording begins a little after the top of the first high arch.
        duration = DURATIONS[HIGH] * pace
        begin = -duration * (0.47 + 0.03 * rng.standard_normal())
        spot = self._spot(1, place, rng)
        kind = HIGH
        while begin < SAMPLES * CONTROL_DT + 1.0:
            following = self._spot(0 if kind == HIGH else 1, place, rng)
            height = HEIGHTS[kind] * size + (0.010, 0.005)[kind] * rng.standard_normal()
            lean = LEANS[kind] + 0.008 * rng.standard_normal()
            self.strokes.append(Stroke(begin, duration, kind, spot, following, height, lean))
            begin += duration
            kind, spot = 1 - kind, following
            duration = DURATIONS[kind] * pace * (1.0 + 0.02 * rng.standard_normal())

    @staticmethod
    def _spot(drum: int, place: FloatArray, rng: np.random.Generator) -> FloatArray:
        x, y = np.array(SPOTS[drum]) + place + 0.006 * rng.standard_normal(2)
        depth = DEPTH * rng.uniform(0.8, 1.2)
        return np.array([x, y, DRUMS[drum].head[2] + TIP_RADIUS - depth])

    def at(self, time: float) -> FloatArray:
        """Return the wanted position of the tip in m, shape (3,)."""
        stroke = next(s for s in reversed(self.strokes) if s.begin <= time)
        phases, rates = self._tremor
        tremor = 0.0008 * np.sin(phases + 2 * np.pi * rates * time).sum(axis=0)
        tremor[2] = 0.0  # the hand does not tremble into a drum
        point: FloatArray = stroke.at(time) + tremor
        return point

    @property
    def rounds(self) -> list[float]:
        """Durations of the rounds in s: of two strokes in turn."""
        begins = [stroke.begin for stroke in self.strokes]
        return [later - earlier for earlier, later in zip(begins, begins[2:], strict=False)]


def record(index: int) -> tuple[FloatArray, list[float]]:
    """Return the tip's positions in m, shape (1000, 3), and the durations of the rounds in s."""
    hand = Hand(np.random.default_rng([SEED, index]))
    simulation = Simulation(DRUMS)
    steps = round(RUN_UP / CONTROL_DT)
    simulation.place(hand.at(-RUN_UP), np.zeros(3))
    path = np.empty((SAMPLES, 3))
    for k in range(-steps, SAMPLES):
        if k >= 0:
            path[k] = simulation.tip
        now, following = hand.at(k * CONTROL_DT), hand.at((k + 1) * CONTROL_DT)
        velocity = (following - now) / CONTROL_DT + PULL * (now - simulation.tip)
        command = simulation.controller.joint_command(velocity)
        simulation.advance(simulation.controller.torque(command.velocity), holding=True)
    return path, hand.rounds


def main() -> None:
    """Record the demonstrations and write them to the file that the package ships."""
    target = sys.argv[1] if len(sys.argv) > 1 else Path(dataset.__file__).with_name(dataset.FILE)
    paths, rounds = zip(*(record(i) for i in range(RECORDINGS)), strict=True)
    period = round(float(np.mean(np.concatenate(rounds))), 4)
    np.savez_compressed(
        target, positions=np.array(paths, dtype=np.float32), dt=CONTROL_DT, period=period
    )


if __name__ == "__main__":
    main()
