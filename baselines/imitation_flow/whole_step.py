"""A step of training by hand, for motions that end in the plane: losses and gradient in NumPy.

The arithmetic of a step is small, and torch takes as long to find it as to do it: hundreds of
tensors of a few hundred numbers, each with a node of the graph. Here the terms of `objectives` and
`calm` are written out with their gradients, over `kernels`, `planar` and `path_error`, for affine
couplings without a context on a CPU. What a step looks at depends on random numbers alone, so it is
prepared for many steps at once. The same step in torch, with random numbers of the same kind, is
what the tests compare it with.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import erfinv
from torch import Tensor

from iflow_gym.baselines.imitation_flow import kernels, planar
from iflow_gym.baselines.imitation_flow.calm import REACH as CALM_REACH
from iflow_gym.baselines.imitation_flow.calm import Calm
from iflow_gym.baselines.imitation_flow.config import ImitationFlowConfig
from iflow_gym.baselines.imitation_flow.coupling import CouplingFlow
from iflow_gym.baselines.imitation_flow.data import Recordings, Task
from iflow_gym.baselines.imitation_flow.latent import MIN_NOISE, LinearLatent
from iflow_gym.baselines.imitation_flow.objectives import LONGEST_HORIZON
from iflow_gym.baselines.imitation_flow.passes import Points
from iflow_gym.baselines.imitation_flow.path_error import path_error

Array = NDArray[np.float32]

AHEAD = 64
"""Steps that are prepared together."""


LOWER = np.tril(np.ones((2, 2), dtype=np.float32))
EYE = np.eye(2, dtype=np.float32)


class Weights(NamedTuple):
    """Of a step's terms; 0 leaves one out."""

    likelihood: float
    reproduction: float
    tube: float
    calm: float


def by_hand(config: ImitationFlowConfig, task: Task, device: torch.device) -> bool:
    """Whether `WholeStep` is the step of such a task."""
    return (
        config.objective == "reproduction"
        and config.emission == "coupling"
        and config.resolved(cyclic=task.cyclic, n_dims=task.n_dims).calm_weight > 0
        and not task.cyclic
        and task.n_dims == 2
        and not task.n_context
        and device.type == "cpu"
    )


class Ahead(NamedTuple):
    """What `AHEAD` steps look at; every array leads with the step and the model, (k, m, ...)."""

    pairs: Array
    """(2, 2 q p): first and last samples of q horizons with p pairs each."""
    horizons: NDArray[np.float64]
    """(q,)."""
    times: Array
    """(n (t + 1),): of the samples of the n recordings, the last among them."""
    target: Array
    """(2, n (t + 1)): the recordings there."""
    along: Array
    """(2, n (t + 1)): their steps there."""
    beside: Array
    """(2, n): starts of the tube."""
    tube_times: Array
    """(n t',)."""
    tube_target: Array
    """(2, n t')."""
    far: Array
    """(2, c): new states of the calm."""


class Preparation:
    """Random numbers, and what they choose, for many steps at once.

    Parameters
    ----------
    config : ImitationFlowConfig
    data : Recordings
    rngs : sequence of numpy.random.Generator
        One a model.
    n_horizons, n_pairs, n_far : int
        Horizons and pairs of each in the likelihood, and new states of the calm.
    """

    def __init__(
        self,
        config: ImitationFlowConfig,
        data: Recordings,
        rngs: Sequence[np.random.Generator],
        n_horizons: int,
        n_pairs: int,
        n_far: int,
    ) -> None:
        self._rngs, self._width = rngs, config.tube_width
        self._q, self._p, self._n_far = n_horizons, n_pairs, n_far
        self._t, self._tube_t = config.n_times, max(config.n_times // 2, 1)
        self._lengths, self._dt = data.lengths.numpy(), data.steps.numpy()
        self._flat, self._stride = data.flat.numpy(), data.stride
        self._centre, self._half = data.centre.numpy(), data.half.numpy()

    def __call__(self) -> Ahead:
        """Prepare the next steps."""
        n, q, p = self._lengths.shape[1], self._q, self._p
        sizes = [q, q, q * p, self._t, 2 * n, self._tube_t, 2 * self._n_far]
        shape = (AHEAD, sum(sizes))
        numbers = np.stack([rng.random(shape, dtype=np.float32) for rng in self._rngs], axis=1)
        which, at, first, times, beside, tube_times, far = np.split(
            numbers, np.cumsum(sizes)[:-1], axis=-1
        )
        pairs, horizons = self._pairs(which, at, first.reshape(*first.shape[:2], q, p))
        samples = self._samples(times)
        ends = np.broadcast_to((self._lengths - 1)[..., None], (*samples.shape[:3], 1))
        samples = np.concatenate([samples, ends], axis=-1)
        target = self._at_each(samples)
        starts = self._at_each(np.zeros_like(samples[..., :1]))
        # Uniform to normal, without the ends, where it is infinite.
        normal = math.sqrt(2) * erfinv(1.998 * beside - 0.999).reshape(*beside.shape[:2], 2, n)
        offset = (self._width * normal).astype(np.float32)
        tube_samples = self._samples(tube_times)
        left = 1 - tube_samples / (self._lengths - 1)[..., None].astype(np.float32)
        drift = (offset[..., None] * left[:, :, None].astype(np.float32)).reshape(
            *offset.shape[:3], -1
        )
        unit = 2 * far.reshape(*far.shape[:2], 2, -1) - 1
        return Ahead(
            pairs,
            horizons,
            self._times(samples),
            target,
            target - self._at_each(samples - 1),
            starts + offset,
            self._times(tube_samples),
            self._at_each(tube_samples) + drift,
            (self._centre + CALM_REACH * self._half * unit).astype(np.float32),
        )

    def _pairs(self, which: Array, at: Array, first: Array) -> tuple[Array, NDArray[np.float64]]:
        """Choose pairs as `objectives.random_pairs` does."""
        recordings = (which * self._lengths.shape[1]).astype(np.int64)
        lengths = np.take_along_axis(self._lengths[None], recordings, axis=2)
        longest = np.maximum(LONGEST_HORIZON * lengths, 1.0)
        share = (np.arange(self._q) + at) / self._q
        steps = np.minimum(np.exp(share * np.log(longest)).astype(np.int64), lengths - 1)
        room = (lengths - steps)[..., None]
        samples = np.minimum((first * room).astype(np.int64), room - 1)
        start = recordings[..., None] * self._stride + samples
        index = np.stack([start, start + steps[..., None]], axis=2)
        dt = np.take_along_axis(self._dt[None], recordings, axis=2)
        return self._at(index.reshape(*index.shape[:2], -1)), dt.astype(np.float64) * steps

    def _samples(self, uniform: Array) -> NDArray[np.int64]:
        """Choose samples as `objectives._samples` does, (k, m, n, t)."""
        n_times = uniform.shape[-1]
        strata = (np.arange(n_times, dtype=np.float32) + uniform) / n_times
        spans = (self._lengths - 1)[..., None]
        return np.minimum(1 + (strata[:, :, None] * spans).astype(np.int64), spans)

    def _times(self, samples: NDArray[np.int64]) -> Array:
        times: Array = (self._dt[..., None] * samples).astype(np.float32)
        return times.reshape(*times.shape[:2], -1)

    def _at_each(self, samples: NDArray[np.int64]) -> Array:
        """Positions (k, m, 2, n t) of samples (k, m, n, t) of each recording."""
        index = np.arange(samples.shape[2])[:, None] * self._stride + samples
        return self._at(index.reshape(*index.shape[:2], -1))

    def _at(self, index: NDArray[np.int64]) -> Array:
        return np.take_along_axis(self._flat[None], index[:, :, None], axis=3)


class WholeStep:
    """Losses and gradient of a step for all models of a batch.

    Parameters
    ----------
    flow : CouplingFlow
        On the CPU, in the plane, without a context.
    latent : LinearLatent
    data : Recordings
    calm : Calm
    preparation : Preparation
    config : ImitationFlowConfig
    """

    def __init__(
        self,
        flow: CouplingFlow,
        latent: LinearLatent,
        data: Recordings,
        calm: Calm,
        preparation: Preparation,
        config: ImitationFlowConfig,
    ) -> None:
        self._flow, self._latent, self._calm = flow, latent, calm
        self._prepare, self._ahead, self._step = preparation, preparation(), -1
        self._path = config.error_power, config.timing_weight, config.end_weight
        m, n = data.n_models, data.n_recordings
        self._n = n
        self._starts = data.flat.numpy()[..., :: data.stride].copy()
        self._goal = np.zeros((m, 2, 1), dtype=np.float32)
        self._frame, self._peak = data.frame.numpy(), data.peak_speed.numpy()
        layers, h, seen = flow.n_layers, flow.hidden_weight.shape[-2] + 1, flow.n_kept + 1
        self._rotation = np.empty((layers, m, 2, 2), dtype=np.float32)
        self._hidden = np.zeros((layers, m, h, seen), dtype=np.float32)
        self._hidden[..., -1, -1] = kernels.SATURATED
        self._out = np.empty((layers, m, 2, h), dtype=np.float32)
        self._alone = m == 1
        rotation, hidden, out = (
            w[:, 0] if self._alone else w for w in (self._rotation, self._hidden, self._out)
        )
        self._weights = kernels.Weights(rotation, hidden, out, flow.n_kept, flow.log_scale_bound)
        self._memory = kernels.Memory()

    def __call__(self, weights: Weights, gradients: Sequence[Tensor]) -> Tensor:
        """Return the sum of the weighted terms, (m,), and fill in the parameters' gradients.

        Those are in the order of the flow's and the latent system's parameters and in their shapes;
        in them, not in the sum, the calm counts with its own weight as well, which grows.
        """
        self._step += 1
        if self._step == AHEAD:
            self._ahead, self._step = self._prepare(), 0
        step = Ahead(*(array[self._step] for array in self._ahead))
        drift, lower = self._drift()
        noise_root = MIN_NOISE + np.exp(self._latent.log_noise.detach().numpy())
        self._fill_weights()

        # What is asked for, by name: states, and for how long the mean dynamics take them on.
        m = len(self._goal)
        asked = {"goal": self._goal, "far": self._far(step)}
        times = {"far": np.full_like(asked["far"][:, 0], self._calm.step)}
        if weights.reproduction:
            asked["starts"], times["starts"] = self._starts, step.times
        if weights.tube:
            asked["beside"], times["beside"] = step.beside, step.tube_times
        if weights.likelihood:
            asked["pairs"] = step.pairs
        points, places = _joined(asked)
        inside = self._inside(points)
        z, log_det, inverse = kernels.inverse(np, inside, None, self._weights, self._memory)
        z, log_det = self._outside(z), self._outside(log_det)
        attractor = z[..., places["goal"]]
        z = z - attractor
        states, ends = _joined(
            {
                name: np.repeat(z[..., places[name]], t.shape[-1] // asked[name].shape[-1], axis=-1)
                for name, t in times.items()
            }
        )
        e = planar.exponential(np, drift, np.concatenate(list(times.values()), axis=-1))
        applied = planar.applied(np, e, states[..., None])
        inside = self._inside(applied.reached[..., 0] + attractor)
        made, forward = kernels.forward(np, inside, None, self._weights, self._memory)

        # Losses and their gradients, and these back the same way.
        total, g_made = self._losses(weights, step, asked["far"], self._outside(made), ends)
        g_z, g_log_det = np.zeros_like(z), np.zeros_like(log_det)
        g_entries: list[planar.Number] = [0.0] * 4
        g_noise: list[planar.Number] = [0.0] * 2
        if weights.likelihood:
            at = places["pairs"]
            noise = _diagonal(noise_root.astype(np.float64) ** 2)
            loss, (g_entries, g_noise), g_z[..., at], g_log_det[:, at] = self._likelihood(
                weights.likelihood, step.horizons, drift, noise, z[..., at], log_det[:, at]
            )
            total = total + loss
        inside = self._inside(g_made)
        g_reached, _, by_forward = kernels.forward_gradient(
            np, inside, forward, self._weights, self._memory
        )
        g_reached = self._outside(g_reached)
        g_states, parts = planar.applied_gradient(np, applied, g_reached[..., None])
        by_states = planar.exponential_gradient(np, e, *parts)
        g_entries = [p + q for p, q in zip(g_entries, by_states, strict=True)]
        for name, end in ends.items():
            shares = g_states[..., end, 0].reshape(m, 2, asked[name].shape[-1], -1)
            g_z[..., places[name]] = shares.sum(-1)
        g_z[..., places["goal"]] = (g_reached.sum(-1) - g_z.sum(-1))[..., None]  # the attractor
        inside, g_det = self._inside(g_z), self._inside(g_log_det)
        _, _, by_inverse = kernels.inverse_gradient(
            np, inside, g_det, inverse, self._weights, self._memory
        )
        *of_flow, factor, skew, log_noise = (g.numpy() for g in gradients)
        self._fill_flow(of_flow, *(p + q for p, q in zip(by_forward, by_inverse, strict=True)))
        g_drift = planar.matrix(np, drift, 2, g_entries)
        turned = g_drift.swapaxes(-1, -2)
        factor[...] = -((g_drift + turned) @ lower) * LOWER
        skew[...] = g_drift - turned
        g_squares = planar.matrix(np, drift, 1, g_noise)[:, 0]
        log_noise[...] = 2 * g_squares * noise_root * (noise_root - MIN_NOISE)
        return torch.from_numpy(total.astype(np.float32, copy=False))

    # Parts of a step -------------------------------------------------------------------------

    def _drift(self) -> tuple[Array, Array]:
        """Return A and L, both (m, 2, 2)."""
        factor, skew = (p.detach().numpy() for p in (self._latent.factor, self._latent.skew))
        lower = factor * LOWER
        drift = skew - skew.swapaxes(-1, -2) - lower @ lower.swapaxes(-1, -2)
        drift -= np.float32(self._latent.min_decay) * EYE
        return drift, lower

    def _fill_weights(self) -> None:
        """Take the flow's parameters over as `kernels` has them."""
        flow = self._flow
        angles = flow.angles.detach().numpy()[..., 0]
        cos, sin = np.cos(angles), np.sin(angles)
        self._rotation[..., 0, 0] = self._rotation[..., 1, 1] = cos
        self._rotation[..., 0, 1], self._rotation[..., 1, 0] = sin, -sin
        self._hidden[..., :-1, :-1] = flow.hidden_weight.detach().numpy()
        self._hidden[..., :-1, -1:] = flow.hidden_bias.detach().numpy()
        self._out[..., :-1] = flow.out_weight.detach().numpy()
        self._out[..., -1:] = flow.out_bias.detach().numpy()
        self._out[..., 0, :] /= flow.log_scale_bound

    def _fill_flow(
        self, into: Sequence[Array], g_rotation: Array, g_hidden: Array, g_out: Array
    ) -> None:
        """Take gradients of `kernels`' weights on to the flow's parameters."""
        angles, hidden_weight, hidden_bias, out_weight, out_bias = into
        if self._alone:
            g_rotation, g_hidden, g_out = (g[:, None] for g in (g_rotation, g_hidden, g_out))
        cos, sin = self._rotation[..., 0, 0], self._rotation[..., 0, 1]
        angles[..., 0] = (g_rotation[..., 0, 1] - g_rotation[..., 1, 0]) * cos
        angles[..., 0] -= (g_rotation[..., 0, 0] + g_rotation[..., 1, 1]) * sin
        g_out[..., 0, :] /= self._flow.log_scale_bound
        hidden_weight[...], hidden_bias[...] = g_hidden[..., :-1, :-1], g_hidden[..., :-1, -1:]
        out_weight[...], out_bias[...] = g_out[..., :-1], g_out[..., -1:]

    def _inside(self, x: Array) -> Array:
        """Return an array (m, ...) as the kernels take it: a single model's products cost less."""
        return x[0] if self._alone else x

    def _outside(self, x: Array) -> Array:
        return x[None] if self._alone else x

    def _far(self, step: Ahead) -> Array:
        """Return the states that the calm looks at: the fastest of before, and new ones."""
        kept = self._calm.kept
        return step.far if kept is None else np.concatenate([kept.states, step.far], axis=-1)

    def _losses(
        self, weights: Weights, step: Ahead, far: Array, made: Array, ends: dict[str, slice]
    ) -> tuple[Array, Array]:
        """Return the weighted losses of what is made, (m,), and its gradient."""
        gradient = np.empty_like(made)
        total, gradient[..., ends["far"]] = self._calm_loss(
            weights.calm, far, made[..., ends["far"]]
        )
        if weights.reproduction:
            at = ends["starts"]
            error = (made[..., at] - step.target).reshape(*made.shape[:2], self._n, -1)
            loss, g_error = path_error(np, error, step.along.reshape(error.shape), *self._path)
            total = total + weights.reproduction * loss
            gradient[..., at] = weights.reproduction * g_error.reshape(*made.shape[:2], -1)
        if weights.tube:
            error = made[..., ends["beside"]] - step.tube_target
            factor = weights.tube / error.shape[-1]
            total = total + factor * (error * error).sum((1, 2))
            gradient[..., ends["beside"]] = 2 * factor * error
        return total, gradient

    def _likelihood(
        self,
        weight: float,
        horizons: NDArray[np.float64],
        drift: Array,
        noise: NDArray[np.float64],
        z: Array,
        log_det: Array,
    ) -> tuple[Array, tuple[list[planar.Number], list[planar.Number]], Array, Array]:
        """Return the weighted term of pairs z (m, 2, 2 q p), (m,), and its gradients.

        Those of the entries of A and of the noise, of z and of its log-determinants.
        """
        m, q = horizons.shape
        before, after = np.moveaxis(z.reshape(m, 2, 2, q, -1), 2, 0)
        made = planar.transition(np, drift.astype(np.float64), noise, before, after, horizons)
        half = before[0, 0].size
        factor = weight / half
        loss = -factor * (made.log_prob.sum((1, 2)) + log_det[:, half:].sum(1))
        *by_latent, g_before, g_after = planar.transition_gradient(
            np, made, np.full_like(made.log_prob, -factor)
        )
        g_z = np.concatenate([g.reshape(m, 2, half) for g in (g_before, g_after)], axis=-1)
        g_log_det = np.zeros_like(log_det)
        g_log_det[:, half:] = -factor
        return loss, (by_latent[0], by_latent[1]), g_z, g_log_det

    def _calm_loss(self, weight: float, y: Array, moved: Array) -> tuple[Array, Array]:
        """Return the weighted penalty of `calm.Calm`, (m,), and the gradient of what is moved.

        The penalty is without the weight that grows, the gradient is with it.
        """
        calm = self._calm
        unit = (calm.step * calm.limit * self._peak)[..., None]
        v = (self._frame @ (moved - y)) / unit
        squares = (v * v).sum(1) + 1e-12
        excess = np.log(squares) / 2
        calm.keep(
            Points(torch.from_numpy(y), torch.zeros(excess.shape, dtype=torch.long)),
            torch.from_numpy(excess),
        )
        above = np.maximum(excess, 0)
        loss = weight * (above * above).mean(1)
        factor = 2 * weight / excess.shape[1] * calm.weight.numpy()[:, None]
        g_v = (factor * above / squares)[:, None] * v
        return loss, self._frame.swapaxes(-1, -2) @ g_v / unit


def _joined(parts: dict[str, Array]) -> tuple[Array, dict[str, slice]]:
    """Join arrays along their last axis; return where each is."""
    ends = np.cumsum([part.shape[-1] for part in parts.values()]).tolist()
    slices = [slice(first, end) for first, end in zip([0, *ends], ends, strict=False)]
    return np.concatenate(list(parts.values()), axis=-1), dict(zip(parts, slices, strict=True))


def _diagonal(squares: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return diagonal matrices (m, 2, 2) of (m, 2)."""
    return squares[..., None] * np.eye(2)
