"""The calm: a penalty on speed away from the recordings, which grows until it is heeded.

Fast places are small, and a step of training looks at a few states. So half of the states of a step
are the fastest of the step before; and from time to time a lattice over twice the recordings' box
is swept: a model that is faster anywhere than `LOUD` times the recordings' peak has the weight of
its penalty doubled, and goes on from the fastest states that were found. A model that is not has it
halved again, down to what it was.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from iflow_gym.baselines.imitation_flow.data import Draws, Recordings
from iflow_gym.baselines.imitation_flow.flow import Flow
from iflow_gym.baselines.imitation_flow.latent import Latent
from iflow_gym.baselines.imitation_flow.passes import Points, Starts, Term, evaluate

REACH = 2.0
"""Speeds are looked at in so many times the recordings' box."""

LOUD = 4.0
"""Speed, in the recordings' peak, from which a model's weight is doubled, and from which it is
trained on at the end. Speeds between the states of a lattice may be a little higher."""

LATTICE = 1600
"""States of a sweep, about."""

MOST_WEIGHT = 64.0
"""The weight grows by this factor at most."""


class Sampling(NamedTuple):
    """How closely speeds are looked at."""

    n_points: int
    """States in a step's penalty."""
    step: float
    """The speed is the mean over this fraction of the duration."""


class Calmness(NamedTuple):
    """How calm a trained model is, and what it took."""

    peak: float
    """Fastest speed that was found in twice the recordings' box, in the recordings' peak speed."""
    rounds: int
    """Rounds of training that were added because it was loud at the end."""


def calmness_of(header: Mapping[str, Any]) -> Calmness | None:
    """Return the calmness that a model file's header holds; None where it does not speak of it.

    Raises ValueError for anything that training does not record.
    """
    if (entry := header.get("calm")) is None:
        return None
    found = Calmness(*entry)
    if type(found.peak) is not float or not found.peak >= 0:
        raise ValueError(f"expected a peak speed >= 0, got {found.peak!r}")
    if type(found.rounds) is not int or found.rounds < 0:
        raise ValueError(f"expected rounds >= 0, got {found.rounds!r}")
    return found


class Calm:
    """Squared log of speed over `limit` times the recordings' peak, in twice their box.

    Parameters
    ----------
    data : Recordings
    sampling : Sampling
    limit : float
        Speeds up to this multiple of the peak cost nothing.

    Attributes
    ----------
    weight : Tensor, shape (m,)
        What each model's penalty is to be multiplied by; 1 until a sweep finds a fast place.
    raised : bool
        Whether that is more than 1 for any model.
    """

    def __init__(self, data: Recordings, sampling: Sampling, limit: float) -> None:
        self._data, self.n_new, self.limit = data, sampling.n_points // 2, limit
        self.step = sampling.step
        self.kept: Points | None = None
        self._kept_excess = data.peak_speed[:, :0]
        self._n_sweeps = 0
        self.raised = False
        self.weight = torch.ones_like(data.peak_speed[:, 0])

    def __call__(self, draws: Draws) -> Term:
        """Return the term of one step."""
        data = self._data
        uniform = draws.uniform(data.n_dims, self.n_new)
        among = (draws.uniform(self.n_new) * data.n_recordings).long()
        points = Points(data.centre + REACH * data.half * (2 * uniform - 1), among)
        if self.kept is not None:
            points = Points(*(torch.cat(pair, -1) for pair in zip(self.kept, points, strict=True)))
        excess = yield from self._excess(points)
        self.keep(points, excess.detach())
        return torch.relu(excess).square().mean(1)

    def sweep(self, flow: Flow, latent: Latent) -> Tensor:
        """Return each model's fastest speed over a lattice in the recordings' peak, (m,).

        No two sweeps have the same lattice. The next step looks at the fastest states, of these
        and of the step before.
        """
        points = self._lattice()
        with torch.no_grad():
            (excess,) = evaluate(flow, latent, self._data, [self._excess(points)])
        if self.kept is not None:
            points = Points(*(torch.cat(pair, -1) for pair in zip(self.kept, points, strict=True)))
            self.keep(points, torch.cat([self._kept_excess, excess], -1))
        else:
            self.keep(points, excess)
        return self.limit * torch.exp(excess.amax(1))

    def watch(self, flow: Flow, latent: Latent, n_sweeps: int = 1) -> Tensor:
        """Sweep, double the weight of models that are loud and halve that of others.

        Returns the fastest speeds, (m,).
        """
        speeds = torch.stack([self.sweep(flow, latent) for _ in range(n_sweeps)]).amax(0)
        changed = torch.where(self.loud(speeds), 2 * self.weight, self.weight / 2)
        self.weight = changed.clamp(1.0, MOST_WEIGHT)
        self.raised = bool((self.weight > 1).any())
        return speeds

    @staticmethod
    def loud(speeds: Tensor) -> Tensor:
        """Return which models are too fast somewhere, (m,), by their fastest speeds."""
        return speeds > LOUD

    def keep(self, points: Points, excess: Tensor) -> None:
        """Keep the fastest of points, with their excess (m, q), for the next step."""
        y, among = points
        self._kept_excess, fastest = excess.topk(self.n_new, dim=1)
        self.kept = Points(
            torch.gather(y, 2, fastest[:, None].expand(-1, y.shape[1], -1)),
            torch.gather(among, 1, fastest),
        )

    def _excess(self, points: Points) -> Generator[Points | Starts, Any, Tensor]:
        """Ask for the logarithm of speed over `limit` times the peak at points, (m, n)."""
        data = self._data
        z, _ = yield points
        y, among = points
        moved = yield Starts(z, z.new_full(among.shape, self.step), among)
        unit = self.step * self.limit * data.peak_speed
        speed = (torch.bmm(data.frame, moved - y) / unit[..., None]).square().sum(1)
        return torch.log(speed.add(1e-12)) / 2

    def _lattice(self) -> Points:
        """Return a lattice over twice the box, shifted by an additive recurrence."""
        data, d = self._data, self._data.n_dims
        n = max(2, round(LATTICE ** (1 / d)))
        self._n_sweeps += 1
        # Roberts' R sequence: powers of the root of x^(d + 1) = x + 1.
        root = 2.0
        for _ in range(50):
            root = (1 + root) ** (1 / (d + 1))
        places = torch.arange(n, dtype=torch.float32)  # whatever the process's default is
        shifts = [math.fmod(self._n_sweeps / root ** (i + 1), 1.0) for i in range(d)]
        axes = [2 * (places + shift) / n - 1 for shift in shifts]
        unit = torch.cartesian_prod(*axes).T.to(data.centre)  # (d, n^d)
        states = data.centre + REACH * data.half * unit
        among = torch.arange(unit.shape[1], device=data.device) % data.n_recordings
        return Points(states, among.expand(data.n_models, -1))
