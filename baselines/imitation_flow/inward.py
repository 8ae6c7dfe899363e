"""The penalty on motion away from the recordings, for motions that repeat in space.

A flow may bend the way back to the orbit far around: stable all the same, but an arm meets the
borders of its workspace on such a way, or a drum, and stays there. So at random states in and
around the recordings' box, y at the distance d from the nearest recorded sample p, d is to shrink,

    <dy/dt, (y - p) / d>  <=  -k d,

and what is above counts squared. States nearer than `NEAR` are left to the other terms.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from iflow_gym.baselines.imitation_flow.data import Draws, Recordings
from iflow_gym.baselines.imitation_flow.passes import Points, Starts, Term

N_STATES = 32
"""States in a step's penalty."""

REACH = 2.5
"""They are drawn from so many times the recordings' box: starts are in twice that, and what leads
from there out of it would be seen too late."""

STEP = 0.005
"""The mean velocity over this fraction of the duration is what counts."""

RATE = 4.0
"""k, per duration."""

NEAR = 0.1
"""In units of the motion."""

SAMPLES = 100
"""Of each recording, among which the nearest is looked for."""


class Inward:
    """Squared excess of the velocity away from the recordings; the worst states are kept."""

    def __init__(self, data: Recordings) -> None:
        self._data, self._n_new = data, N_STATES // 2
        self._kept: Points | None = None
        n = torch.arange(SAMPLES, device=data.device)
        among = torch.arange(data.n_recordings, device=data.device).repeat_interleave(SAMPLES)
        samples = (n * (data.lengths[..., None] - 1)) // (SAMPLES - 1)
        self._shown = data.at(among.expand(data.n_models, -1), samples.flatten(1))

    def __call__(self, draws: Draws) -> Term:
        """Return the term of one step."""
        data = self._data
        uniform = draws.uniform(data.n_dims, self._n_new)
        among = (draws.uniform(self._n_new) * data.n_recordings).long()
        points = Points(data.centre + REACH * data.half * (2 * uniform - 1), among)
        if self._kept is not None:
            points = Points(*(torch.cat(pair, -1) for pair in zip(self._kept, points, strict=True)))
        z, _ = yield points
        y, among = points
        moved = yield Starts(z, z.new_full(among.shape, STEP), among)
        offset, distance = self._from_nearest(y)
        outward = ((moved - y) * offset).sum(1) / (STEP * distance)
        excess = (outward + RATE * distance) / (2 * math.pi)
        excess = torch.where(distance > NEAR, excess, torch.zeros_like(excess)).relu()
        worst = excess.detach().topk(self._n_new, dim=1).indices
        self._kept = Points(
            torch.gather(y, 2, worst[:, None].expand(-1, data.n_dims, -1)),
            torch.gather(among, 1, worst),
        )
        return excess.square().mean(1)

    def _from_nearest(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """Return y less its nearest recorded sample, (m, d, q), and its length, (m, q)."""
        nearest = torch.cdist(y.mT, self._shown.mT).argmin(-1)
        shown = torch.gather(self._shown, 2, nearest[:, None].expand(-1, y.shape[1], -1))
        offset = y - shown
        return offset, offset.norm(dim=1).clamp_min(1e-9)
