"""The orbit that recordings of a cycle have in common, and how precisely each place of it is known.

The likelihood of transitions sees the orbit through the spread of whole recordings, and a smooth
flow rounds a sharp turn off. Where all recordings do the same, as a drummer does at the head of the
drum, that is wrong by many times their spread. Here the orbit of the model is a curve with a normal
density around it,

    h(rho* (cos, sin)(b u + psi0)) ~ N(c(u), S(u) + tau^2 c'(u) c'(u)^T + eps^2 I),

c(u) the mean of the recordings at phase u, S(u) their spread about it, tau the standard error of
its phase (theirs spread over the root of the number of rounds), and eps the resolution. So the
orbit is held tightly where the recordings agree and loosely where they differ, and a round of the
model, at the latent rate b over the times u in (-1/2, 1/2), takes their mean period. The phase
psi0 is the circular mean of what the model takes c(u) for.

Tempo varies within a round, which would blur turns in a mean over time. So pieces of the recordings
are shifted in time to where their shape is the mean's, and the mean is taken again; it passes in
the recordings' mean time.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from iflow_gym.baselines.imitation_flow.data import Frame, Recordings, Task
from iflow_gym.baselines.imitation_flow.limit_cycle import LimitCycleLatent
from iflow_gym.baselines.imitation_flow.passes import Points, Starts, Term
from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.phases import common_phases

N_PHASES = 240
"""Phases at which the orbit is compared."""

GRID = 480
"""Cells of a round in which recordings are averaged."""

WINDOW, REACH = 12, 24
"""Cells to either side of the pieces that are aligned, and how far they may lie apart."""

ALIGNMENTS = 5
"""Times that recordings are aligned with their mean and averaged again."""

ENCODED = 8
"""Every so many-th of the curve's points is encoded for the phase."""


def mean_orbit(motion: Demonstrations) -> tuple[FloatArray, FloatArray]:
    """Return the curve (n, d) at phases k / n, even in time, and its covariances (n, d, d)."""
    phases = common_phases(motion)
    cells = [np.arange(np.ceil(u[0] * GRID), u[-1] * GRID).astype(np.intp) for u in phases]
    paths = [
        np.stack([np.interp(k / GRID, u, x) for x in p.T], axis=1)
        for k, u, p in zip(cells, phases, motion.positions, strict=True)
    ]
    lags = [np.zeros(len(k)) for k in cells]
    places = np.concatenate(cells) % GRID
    states = np.concatenate(paths)
    # Pieces at a recording's ends cannot be shifted: they count where there is nothing else.
    inside = [np.minimum(np.arange(len(k)), np.arange(len(k))[::-1]) for k in cells]
    shares = np.clip(np.concatenate(inside) / (WINDOW + REACH), 1e-6, 1.0) ** 2
    for _ in range(ALIGNMENTS):
        mean = _mean(places, states, shares)
        lags = [_lags(path, mean[k % GRID]) for path, k in zip(paths, cells, strict=True)]
        late = _mean(places, np.concatenate(lags)[:, None], shares)[:, 0]
        lags = [lag - late[k % GRID] for lag, k in zip(lags, cells, strict=True)]
        states = np.concatenate([_shifted(p, lag) for p, lag in zip(paths, lags, strict=True)])
    mean = _mean(places, states, shares)
    away = states - mean[places]
    squares = (away[:, :, None] * away[:, None, :]).reshape(len(away), -1)
    spread = _mean(places, squares, shares)
    n_rounds = len(states) / GRID
    tau = np.concatenate(lags).std() / GRID / np.sqrt(n_rounds)
    along = GRID / 2 * (np.roll(mean, -1, axis=0) - np.roll(mean, 1, axis=0))
    spread = spread.reshape(GRID, *along.shape[1:] * 2)
    every = GRID // N_PHASES
    covariance = spread + tau**2 * along[:, :, None] * along[:, None, :]
    return mean[::every], covariance[::every]


def _mean(places: NDArray[np.intp], values: FloatArray, shares: FloatArray) -> FloatArray:
    """Return the weighted mean of values (n, k) at each of GRID places, shape (GRID, k).

    Where recordings of about one round leave a place out it is interpolated from its neighbours.
    """
    totals = np.bincount(places, shares, GRID)
    seen, every = np.flatnonzero(totals), np.arange(GRID)
    columns = [
        np.interp(
            every, seen, np.bincount(places, shares * column, GRID)[seen] / totals[seen],
            period=GRID,
        )
        for column in values.T
    ]  # fmt: skip
    return np.stack(columns, axis=1)


def _lags(path: FloatArray, mean: FloatArray) -> FloatArray:
    """Return by how many cells a path (n, d) is behind the mean (n, d), place by place, (n,).

    The pieces around each place are compared by their shapes, whatever their offsets.
    """
    around, shifts = np.arange(-WINDOW, WINDOW + 1), np.arange(-REACH, REACH + 1)
    places = np.arange(len(path))

    def pieces(curve: FloatArray) -> FloatArray:
        cut = curve[np.clip(places[:, None] + around, 0, len(curve) - 1)]
        return np.asarray(cut - cut.mean(axis=1, keepdims=True))

    own, wanted = pieces(path), pieces(mean)
    errors = np.stack(
        [np.square(own[np.clip(places + k, 0, len(path) - 1)] - wanted).sum((1, 2)) for k in shifts]
    )
    weights = np.exp(-(errors - errors.min(axis=0)) / (0.1 * errors.mean(axis=0) + 1e-300))
    found = (weights * shifts[:, None]).sum(axis=0) / weights.sum(axis=0)
    smooth = gaussian_filter1d(found, WINDOW / 4, mode="nearest")
    ahead = np.maximum.accumulate(places + smooth)  # time does not run backwards
    return np.asarray(ahead - places)


def _shifted(path: FloatArray, lags: FloatArray) -> FloatArray:
    """Return a path (n, d) read so many cells later, place by place."""
    places = np.arange(len(path))
    return np.stack([np.interp(places + lags, places, x) for x in path.T], axis=1)


class MeanOrbit:
    """The term: minus the mean log density of the model's orbit, without its constant."""

    def __init__(self, tasks: Sequence[Task], data: Recordings, resolution: float) -> None:
        points, roots, firsts = [], [], []
        for task in tasks:
            inverse = np.linalg.inv(Frame.of(task).matrix)
            first = 0
            for motion, origin in zip(task.motions, task.origins, strict=True):
                curve, spread = mean_orbit(motion)
                covariance = inverse @ spread @ inverse.T + resolution**2 * np.eye(task.n_dims)
                points.append((curve - origin) @ inverse.T)
                roots.append(np.linalg.inv(np.linalg.cholesky(covariance)))
                firsts.append(first)
                first += len(motion)

        def tensor(rows: Sequence[FloatArray]) -> Tensor:
            """Of shape (m, k n, ...), k motions a task."""
            array = np.stack(rows).astype(np.float32).reshape(len(tasks), -1, *rows[0].shape[1:])
            return torch.as_tensor(array, device=data.device)

        self._points, self._whitening = tensor(points).mT.contiguous(), tensor(roots)
        among = torch.as_tensor(firsts, device=data.device).view(len(tasks), -1)
        self._recordings = among.repeat_interleave(N_PHASES, dim=1)
        self._n_motions = among.shape[1]
        u = torch.arange(N_PHASES, device=data.device) / N_PHASES
        self._times = torch.where(u < 0.5, u, u - 1)  # in periods: a round, from -1/2 to 1/2

    def __call__(self, latent: LimitCycleLatent) -> Term:
        """Return the term of one step."""
        seen = self._points[..., ::ENCODED], self._recordings[:, ::ENCODED]
        z, _ = yield Points(*seen)
        turned = latent.rate[:, None, None] * self._times
        with torch.no_grad():
            angle = torch.atan2(z[:, 1], z[:, 0]).unflatten(1, (self._n_motions, -1))
            ahead = angle - turned[..., ::ENCODED]
            offset = torch.atan2(ahead.sin().mean(-1), ahead.cos().mean(-1))
        psi = (turned + offset[..., None]).flatten(1)
        circle = latent.radius()[:, None, None] * torch.stack([psi.cos(), psi.sin()], dim=1)
        others = circle.new_zeros(len(circle), self._points.shape[1] - 2, circle.shape[2])
        cycle = torch.cat([circle, others], dim=1)
        made = yield Starts(cycle, torch.zeros_like(psi), self._recordings)
        error = torch.einsum("mqij,mjq->miq", self._whitening, made - self._points)
        return error.square().sum(1).mean(1) / 2
