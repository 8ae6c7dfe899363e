"""One pass through the flow for everything that a training step asks of it.

A term of the objective is a generator. It yields points of the observed space and is sent their
latent states; it may then yield latent states with times, and be sent the points that the mean
dynamics reach from them; it returns its loss, one number a model. `evaluate` joins what all the
terms of a step ask, so that the flow, where training spends its time, is passed once in each
direction.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from iflow_gym.baselines.imitation_flow.data import Recordings
from iflow_gym.baselines.imitation_flow.flow import Flow
from iflow_gym.baselines.imitation_flow.latent import Latent


class Points(NamedTuple):
    """States (m, d, q), and the recordings (m, q) in whose context they are."""

    states: Tensor
    recordings: Tensor


class Starts(NamedTuple):
    """Latent states (m, d, q) relative to the attractor, times (m, q), recordings (m, q)."""

    z: Tensor
    times: Tensor
    recordings: Tensor


class Encoded(NamedTuple):
    """Latent states relative to the attractor (m, d, q), and log |det dz/dy| (m, q)."""

    z: Tensor
    log_det: Tensor


Term = Generator["Points | Starts", Any, Tensor]
"""Yields `Points`, is sent `Encoded`; may yield `Starts`, is sent states (m, d, q)."""


def evaluate(flow: Flow, latent: Latent, data: Recordings, terms: Sequence[Term]) -> list[Tensor]:
    """Run terms to their losses, each (m,), in their order.

    Latent states are relative to the attractor: to h^-1(goal) where motions end, and to nothing
    where they repeat.
    """
    losses: dict[int, Tensor] = {}
    asked = [cast(Points, next(term)) for term in terms]
    weights = flow.weights()
    parts, attractors = _inverse(flow, data, asked, weights)
    wanted: dict[int, Starts] = {}
    for i, (term, part) in enumerate(zip(terms, parts, strict=True)):
        try:
            wanted[i] = cast(Starts, term.send(part))
        except StopIteration as end:
            losses[i] = end.value
    if wanted:
        z, times, recordings = (torch.cat(p, dim=-1) for p in zip(*wanted.values(), strict=True))
        states = latent.propagate(z, times)
        states = states + _of(attractors, data, recordings)
        made = flow(states, data.context_of(recordings), weights)
        sizes = [starts.times.shape[-1] for starts in wanted.values()]
        for i, part in zip(wanted, made.split(sizes, -1), strict=True):
            try:
                terms[i].send(part)
            except StopIteration as end:
                losses[i] = end.value
    return [losses[i] for i in range(len(terms))]


def encode(flow: Flow, data: Recordings, points: Points) -> Encoded:
    """Return latent states relative to the attractor, as `evaluate` sends them."""
    return _inverse(flow, data, [points], flow.weights())[0][0]


def _inverse(
    flow: Flow, data: Recordings, asked: Sequence[Points], weights: Any
) -> tuple[list[Encoded], Tensor | None]:
    """Return what was asked, and the attractors: (m, d, n), or (m, d, 1) without a context."""
    goals = [] if data.cyclic else [_goals(data)]
    joined = _joined([*asked, *goals])
    z, log_det = flow.inverse(joined.states, data.context_of(joined.recordings), weights)
    sizes = [points.states.shape[-1] for points in (*asked, *goals)]
    parts, log_dets = z.split(sizes, -1), log_det.split(sizes, -1)
    attractors = parts[-1] if goals else None
    return [
        Encoded(part - _of(attractors, data, points.recordings), determinant)
        for part, determinant, points in zip(parts, log_dets, asked, strict=False)
    ], attractors


def _joined(points: Sequence[Points]) -> Points:
    return Points(
        torch.cat([p.states for p in points], dim=-1),
        torch.cat([p.recordings for p in points], dim=-1),
    )


def _goals(data: Recordings) -> Points:
    """Return the goal in each recording's context, or once where there is no context."""
    n = 1 if data.context is None else data.n_recordings
    everyone = torch.arange(n, device=data.device).expand(data.n_models, n)
    return Points(data.centre.new_zeros(data.n_models, data.n_dims, n), everyone)


def _of(attractors: Tensor | None, data: Recordings, recordings: Tensor) -> Tensor | float:
    """Return the attractor of each point, to broadcast over (m, d, q)."""
    if attractors is None:
        return 0.0
    if data.context is None:
        return attractors
    return torch.gather(attractors, 2, recordings[:, None].expand(-1, data.n_dims, -1))
