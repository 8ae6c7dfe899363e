"""The terms of ImitationFlow's objectives, each a generator for `passes.evaluate`.

Forward likelihood, reproduction and tube are the default's, and the calm, which is in `calm`;
backward likelihood and end are Algorithm 1's (paper, eqs. 6 and 7).
"""

from __future__ import annotations

import math
from collections.abc import Generator
from typing import Any

import torch
from torch import Tensor

from iflow_gym.baselines.imitation_flow.data import Draws, Recordings
from iflow_gym.baselines.imitation_flow.latent import Latent
from iflow_gym.baselines.imitation_flow.passes import Points, Starts, Term
from iflow_gym.baselines.imitation_flow.path_error import PathError

LONGEST_HORIZON = 0.6
"""Longest horizon of the likelihood, as a fraction of the recording."""


def everyone(data: Recordings) -> Tensor:
    """Return the indices of all recordings, shape (m, n)."""
    n = data.n_recordings
    return torch.arange(n, device=data.device).expand(data.n_models, n)


def random_pairs(
    data: Recordings, draws: Draws, n_horizons: int, n_pairs: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Draw a recording (m, q), a step count (m, q) and first samples (m, q, p) for each horizon.

    The q horizons lie one in each stratum: log-uniform from one sample to `LONGEST_HORIZON` of the
    recording where motions end, uniform up to one period where they repeat. Each has one recording,
    so that its p pairs share one transition (Algorithm 1's sampling time).
    """
    recordings = (draws.uniform(n_horizons) * data.n_recordings).long()
    lengths = torch.gather(data.lengths, 1, recordings)
    strata = torch.arange(n_horizons, device=data.device)
    at = (strata + draws.uniform(n_horizons)) / n_horizons
    if data.cyclic:  # times are in periods
        steps = (at / torch.gather(data.steps, 1, recordings)).long().clamp_min(1)
    else:
        longest = (LONGEST_HORIZON * lengths.float()).clamp_min(1.0)
        steps = torch.exp(at * torch.log(longest)).long()
    steps = torch.minimum(steps, lengths - 1)
    room = (lengths - steps)[..., None]
    first = torch.minimum((draws.uniform(n_horizons, n_pairs) * room).long(), room - 1)
    return recordings, steps, first


def pairs_of(
    data: Recordings, recordings: Tensor, steps: Tensor, first: Tensor
) -> tuple[Points, Tensor]:
    """Return both ends, (m, d, 2 q p), of the pairs, and their times (m, q)."""
    among = recordings[..., None].expand_as(first).flatten(1)
    first = first.flatten(1)
    last = first + steps[..., None].expand(*steps.shape, first.shape[1] // steps.shape[1]).flatten(
        1
    )
    states = torch.cat([data.at(among, first), data.at(among, last)], dim=-1)
    times = torch.gather(data.steps, 1, recordings) * steps
    return Points(states, among.repeat(1, 2)), times


def forward_likelihood(
    latent: Latent, data: Recordings, draws: Draws, n_horizons: int, n_pairs: int
) -> Term:
    """-log p(y_{i+k} | y_i), mean over random transitions."""
    points, times = pairs_of(data, *random_pairs(data, draws, n_horizons, n_pairs))
    z, log_det = yield points
    before, after = z.unflatten(-1, (2, n_horizons, n_pairs)).unbind(2)
    log_prob = latent.transition_log_prob(before, after, times)
    return -(log_prob.flatten(1) + log_det.chunk(2, -1)[1]).mean(1)


def backward_likelihood(
    latent: Latent, data: Recordings, draws: Draws, n_horizons: int, n_pairs: int
) -> Term:
    """Algorithm 1's loss a transition: backward conditionals, and the stationary density."""
    recordings, steps, first = random_pairs(data, draws, n_horizons, n_pairs)
    pairs, times = pairs_of(data, recordings, steps, first)
    everybody = everyone(data)
    ends = data.at(everybody, data.lengths - 1)
    z, log_det = yield Points(
        torch.cat([pairs.states, ends], dim=-1), torch.cat([pairs.recordings, everybody], dim=-1)
    )
    n = n_horizons * n_pairs
    before, after = z[..., : 2 * n].unflatten(-1, (2, n_horizons, n_pairs)).unbind(2)
    conditional = latent.backward_log_prob(before, after, times).flatten(1) + log_det[:, :n]
    end = latent.stationary_log_prob(z[..., 2 * n :]) + log_det[:, 2 * n :]
    n_transitions = (data.lengths.float().mean(1) - steps.float().mean(1)).clamp_min(1.0)
    return -(conditional.mean(1) + end.mean(1) / n_transitions)


def stationary(latent: Latent, data: Recordings, draws: Draws, n_points: int) -> Term:
    """-log density of the state in the limit, at random samples: of the radius, for a cycle."""
    recordings = (draws.uniform(n_points) * data.n_recordings).long()
    lengths = torch.gather(data.lengths, 1, recordings)
    samples = torch.minimum((draws.uniform(n_points) * lengths).long(), lengths - 1)
    z, log_det = yield Points(data.at(recordings, samples), recordings)
    return -(latent.stationary_log_prob(z) + log_det).mean(1)


def reproduction(
    data: Recordings,
    draws: Draws,
    n_times: int,
    *,
    power: float = 1.0,
    timing_weight: float = 1.0,
    end_weight: float = 0.0,
) -> Term:
    """Squared error of whole reproductions at stratified times.

    Its part along the recording, which is an error in time, counts `timing_weight`; a recording's
    errors e over the times count as (mean e^p)^(1/p). With an `end_weight` the squared error at the
    last sample counts by itself: the motion has to be over then, which random times see too seldom.
    """
    everybody = everyone(data)
    starts = data.at(everybody, torch.zeros_like(everybody))
    samples = _samples(data, draws, n_times)
    ends = (data.lengths - 1)[..., None]
    made, target, along = yield from _reproduced(data, starts, torch.cat([samples, ends], dim=-1))
    settings = power, timing_weight, end_weight
    error: Tensor = PathError.apply(made, target, along, data.n_recordings, *settings)
    return error


def tube(data: Recordings, draws: Draws, n_times: int, *, width: float) -> Term:
    """Squared error of whole reproductions from beside the recordings' starts.

    Starts are moved by a normal offset of the width, and the target is the recording beside which
    the offset shrinks in proportion to the time that is left.
    """
    n, everybody = data.n_recordings, everyone(data)
    normal = math.sqrt(2) * torch.erfinv(1.998 * draws.uniform(data.n_dims, n) - 0.999)
    offset = width * normal
    starts = data.at(everybody, torch.zeros_like(everybody)) + offset
    samples = _samples(data, draws, n_times)
    left = 1 - samples.float() / (data.lengths - 1).float()[..., None]
    made, target, _ = yield from _reproduced(data, starts, samples)
    target = target + (offset[..., None] * left[:, None]).flatten(2)
    return (made - target).square().sum(1).mean(1)


def _samples(data: Recordings, draws: Draws, n_times: int) -> Tensor:
    """Draw samples (m, n, n_times) of each recording, one in each stratum, not the first."""
    strata = (torch.arange(n_times, device=data.device) + draws.uniform(n_times)) / n_times
    spans = (data.lengths - 1)[..., None]
    return torch.minimum(1 + (strata[:, None] * spans).long(), spans)


def _reproduced(
    data: Recordings, starts: Tensor, samples: Tensor
) -> Generator[Points | Starts, Any, tuple[Tensor, Tensor, Tensor]]:
    """Ask for what is made of starts (m, d, n) at samples (m, n, q) of the recordings.

    Returns it, the recordings, and their steps there, each (m, d, n q).
    """
    everybody, n_times = everyone(data), samples.shape[-1]
    samples = samples.flatten(1)
    among = everybody[..., None].expand(-1, -1, n_times).flatten(1)
    times = torch.gather(data.steps, 1, among) * samples
    target = data.at(among, samples)
    z, _ = yield Points(starts, everybody)
    made = yield Starts(z.repeat_interleave(n_times, dim=-1), times, among)
    return made, target, target - data.at(among, samples - 1)
