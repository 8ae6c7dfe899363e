"""Training many ImitationFlows as one batched model.

Positions are divided by one scale per motion and centred nowhere (the goal is mapped to the latent
origin by subtraction); times are divided by the mean duration of the motion's recordings. The
objectives are those of `ImitationFlowConfig.objective`:

"paper"
    Algorithm 1: backward conditionals p(y_i | y_{i+dT}) for a random sampling time dT, and the
    stationary density at the last sample (eqs. 6 and 7, with the latent densities of sec. III-B
    in closed form). The backward conditional is the paper's N(F^-1 z', F^-1 Sigma F^-T): the
    reverse under a flat prior on z, not under the stationary density.

"reproduction"
    First the forward conditional likelihood p(y_{i+k} | y_i) over horizons k, log-uniform up to
    60 % of the recording. Then the reproduction itself: from a recording's first sample
    y^(t) = h(exp(A t) h^-1(y_0)) in closed form, squared error to y(t) at random times t, with the
    likelihood kept at a small weight. Two penalties shape the field beside the data: the tube and
    the calm, see the configuration. Last, with the flow and A fixed, the noise is fitted by the
    same likelihood.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from iflow_gym.baselines.imitation_flow.config import ImitationFlowConfig
from iflow_gym.baselines.imitation_flow.flow import CouplingFlow
from iflow_gym.baselines.imitation_flow.latent import (
    LinearLatent,
    gaussian_log_prob,
    propagator,
    stationary_covariance,
    transition,
)
from iflow_gym.demonstrations import Demonstrations

LONGEST_HORIZON = 0.6
"""Longest horizon of the likelihood, as a fraction of the recording."""

WARM_UP = 0.15
"""Share of the steps in which the learning rate rises."""

SQUARED_ERROR_WEIGHT = 100.0
"""Weight of the squared error, against which the penalties are measured."""

MOST_DROPPED = 0.01
"""Steps whose gradient is not finite are left out; more than this share of them is no fit."""

CALM_POINTS = 32
CALM_STEP = 0.02
"""The calm penalty sees the mean speed over this fraction of the duration, from so many states."""

NOISE_STEPS = 200
NOISE_PAIRS = 2000
NOISE_RATE = 0.05


class TrainingError(RuntimeError):
    """Training did not end in finite parameters."""


@dataclass(frozen=True)
class Scales:
    """Units of one motion: length per latent unit, seconds per latent time."""

    length: float
    time: float

    @classmethod
    def of(cls, demonstrations: Demonstrations) -> Scales:
        """Take the largest distance from the goal along an axis, and the mean duration."""
        offsets = np.concatenate(demonstrations.positions) - demonstrations.attractor
        return cls(float(np.abs(offsets).max()), float(demonstrations.durations.mean()))


class _Recordings:
    """The demonstrations of m motions with n recordings each, as padded tensors."""

    def __init__(self, motions: Sequence[Demonstrations], device: torch.device) -> None:
        scales = [Scales.of(motion) for motion in motions]
        n, d = len(motions[0]), motions[0].n_dims
        lengths = np.array([[len(p) for p in motion.positions] for motion in motions])
        padded = np.zeros((len(motions), n, lengths.max(), d), dtype=np.float32)
        for m, (motion, scale) in enumerate(zip(motions, scales, strict=True)):
            for i, positions in enumerate(motion.positions):
                padded[m, i, : len(positions)] = (positions - motion.attractor) / scale.length
        steps = np.array(
            [[h / s.time for h in motion.dt] for motion, s in zip(motions, scales, strict=True)]
        )
        boxes = [
            [(corner - motion.attractor) / s.length for corner in motion.bounding_box]
            for motion, s in zip(motions, scales, strict=True)
        ]
        speeds = [m.peak_speed * s.time / s.length for m, s in zip(motions, scales, strict=True)]

        def tensor(array: object) -> Tensor:
            return torch.as_tensor(np.asarray(array, dtype=np.float32), device=device)

        self.n_models, self.n_recordings, self.n_dims = len(motions), n, d
        self.lengths = lengths
        self.positions, self.steps, self.peak_speed = tensor(padded), tensor(steps), tensor(speeds)
        box = tensor(boxes)
        self.centre, self.half = box.mean(1, keepdim=True), (box[:, 1:] - box[:, :1]) / 2
        self.device = device
        self._models = torch.arange(len(motions), device=device)[:, None]

    def at(self, recordings: NDArray[np.int64], samples: NDArray[np.int64]) -> Tensor:
        """Positions, shape (m, k, d), of samples (m, k) of recordings (m, k)."""
        return self.positions[self._models, self._index(recordings), self._index(samples)]

    def durations(self, recordings: NDArray[np.int64], n_steps: NDArray[np.int64]) -> Tensor:
        """Latent time, shape (m, k), of a number of steps (m, k) of recordings (m, k)."""
        return self.steps[self._models, self._index(recordings)] * self._index(n_steps)

    def _index(self, array: NDArray[np.int64]) -> Tensor:
        return torch.tensor(array, device=self.device)


class _Draws:
    """Random numbers, drawn a model at a time so that a model's do not depend on its neighbours."""

    def __init__(self, rngs: Sequence[np.random.Generator]) -> None:
        self.rngs = rngs

    def uniform(self, *shape: int) -> NDArray[np.float32]:
        return np.stack([rng.random(shape, dtype=np.float32) for rng in self.rngs])

    def normal(self, *shape: int) -> NDArray[np.float32]:
        return np.stack([rng.standard_normal(shape, dtype=np.float32) for rng in self.rngs])


class BatchedModel(nn.Module):
    """`n_models` flows and latent systems, with the latent attractor at h^-1(goal)."""

    def __init__(
        self, config: ImitationFlowConfig, n_dims: int, generators: list[torch.Generator]
    ) -> None:
        super().__init__()
        self.flow = CouplingFlow(
            len(generators),
            n_dims,
            config.n_layers,
            config.n_hidden,
            log_scale_bound=config.log_scale_bound,
            sharpness=config.sharpness,
            generators=generators,
        )
        self.latent = LinearLatent(len(generators), n_dims, min_decay=config.min_decay)

    def encode(self, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return z relative to the attractor (m, n, d), the attractor (m, 1, d), log |det|."""
        goal = y.new_zeros(y.shape[0], 1, y.shape[2])
        z, log_det = self.flow.inverse(torch.cat([y, goal], dim=1))
        return z[:, :-1] - z[:, -1:], z[:, -1:], log_det[:, :-1]

    def parameters_by_model(self) -> list[tuple[nn.Parameter, int]]:
        """Each parameter with the dimension that counts the models."""
        return [(p, 1) for p in self.flow.parameters()] + [(p, 0) for p in self.latent.parameters()]


def train(
    config: ImitationFlowConfig,
    motions: Sequence[Demonstrations],
    rngs: Sequence[np.random.Generator],
) -> BatchedModel:
    """Train one model for each motion (all with as many recordings and dimensions) and generator.

    Returns the models on the CPU; raises `TrainingError` if one is not finite. On a CPU training
    takes one thread: its tensors are small, and threads that wait for each other made a fit ten
    times as slow on a busy machine.
    """
    with _one_thread():
        return _train(config, motions, rngs)


@contextmanager
def _one_thread() -> Iterator[None]:
    n_threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(n_threads)


def _train(
    config: ImitationFlowConfig,
    motions: Sequence[Demonstrations],
    rngs: Sequence[np.random.Generator],
) -> BatchedModel:
    device = torch.device(
        ("cuda" if torch.cuda.is_available() else "cpu")
        if config.device == "auto"
        else config.device
    )
    data = _Recordings(motions, device)
    draws = _Draws(rngs)
    generators = [torch.Generator().manual_seed(int(rng.integers(2**63))) for rng in rngs]
    model = BatchedModel(config, data.n_dims, generators).to(device)
    optimizer = torch.optim.Adam(
        model.parameters(), lr=config.learning_rate, betas=(0.9, 0.99), fused=True
    )
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, config.learning_rate, total_steps=config.n_steps, pct_start=WARM_UP
    )
    dropped = torch.zeros(data.n_models, device=device)
    n_likelihood = round(config.likelihood_fraction * config.n_steps)
    for step in range(config.n_steps):
        if config.objective == "paper":
            loss = _backward_likelihood(config, model, data, draws)
        elif step < n_likelihood:
            loss = _forward_likelihood(config, model, data, draws)
        else:
            loss = _reproduction(config, model, data, draws)
            if config.likelihood_weight:
                loss = loss + config.likelihood_weight * _forward_likelihood(
                    config, model, data, draws
                )
        if config.calm_weight and config.objective == "reproduction":
            loss = loss + config.calm_weight * _calm(config, model, data, draws)
        optimizer.zero_grad()
        loss.sum().backward()
        dropped += ~_clip_gradients(model, config.max_gradient_norm)
        optimizer.step()
        schedule.step()
    if config.objective == "reproduction":
        _fit_noise(model, data, draws)
    model = model.to("cpu")
    lost = (dropped / config.n_steps).tolist()
    for motion, finite, share in zip(motions, _finite(model).tolist(), lost, strict=True):
        if not finite or share > MOST_DROPPED:
            raise TrainingError(
                f"ImitationFlow did not converge on {motion.name!r}: {share:.0%} of its gradients "
                f"were not finite. Lower learning_rate (now {config.learning_rate}) or the weights."
            )
    return model


def _random_pairs(
    data: _Recordings, draws: _Draws, n_pairs: int, horizon: NDArray[np.float32]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Draw recordings, first samples and step counts, each (m, n_pairs), for horizons in (0, 1].

    A horizon is where a step count lies between 1 and the longest, on a logarithmic scale.
    """
    uniform = draws.uniform(2, n_pairs)
    recordings = (uniform[:, 0] * data.n_recordings).astype(np.int64)
    lengths = np.take_along_axis(data.lengths, recordings, axis=1)
    longest = np.maximum(LONGEST_HORIZON * lengths, 1.0)
    steps = np.minimum(np.exp(horizon * np.log(longest)).astype(np.int64), lengths - 1)
    first = (uniform[:, 1] * (lengths - steps)).astype(np.int64)
    return recordings, np.minimum(first, lengths - 1 - steps), steps


def _encoded_pairs(
    model: BatchedModel,
    data: _Recordings,
    pairs: tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]],
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Latent states before and after (m, k, d), their log |det|, and the time between (m, k)."""
    recordings, first, steps = pairs
    y = torch.cat([data.at(recordings, first), data.at(recordings, first + steps)], dim=1)
    z, _, log_det = model.encode(y)
    k = recordings.shape[1]
    times = data.durations(recordings, steps)
    return z[:, :k], z[:, k:], log_det[:, :k], log_det[:, k:], times


def _forward_likelihood(
    config: ImitationFlowConfig, model: BatchedModel, data: _Recordings, draws: _Draws
) -> Tensor:
    """-log p(y_{i+k} | y_i), mean over random transitions: shape (m,)."""
    pairs = _random_pairs(data, draws, config.n_pairs, draws.uniform(config.n_pairs))
    before, after, _, log_det, times = _encoded_pairs(model, data, pairs)
    forward, covariance = transition(model.latent.drift(), model.latent.diffusion(), times)
    residual = after - (forward @ before[..., None])[..., 0]
    return -(gaussian_log_prob(residual, covariance) + log_det).mean(1)


def _backward_likelihood(
    config: ImitationFlowConfig, model: BatchedModel, data: _Recordings, draws: _Draws
) -> Tensor:
    """Algorithm 1's loss per transition, one sampling time a step: shape (m,)."""
    horizon = np.broadcast_to(draws.uniform(1), (data.n_models, config.n_pairs))
    pairs = _random_pairs(data, draws, config.n_pairs, horizon)
    before, after, log_det, _, times = _encoded_pairs(model, data, pairs)
    drift, diffusion = model.latent.drift(), model.latent.diffusion()
    forward, covariance = transition(drift, diffusion, times)
    # log N(z | F^-1 z', F^-1 Sigma F^-T) = log N(z' | F z, Sigma) + log |det F|
    residual = after - (forward @ before[..., None])[..., 0]
    log_det_forward = torch.diagonal(drift, dim1=-2, dim2=-1).sum(-1)[:, None] * times
    conditional = gaussian_log_prob(residual, covariance) + log_det_forward + log_det
    everyone = np.broadcast_to(np.arange(data.n_recordings), data.lengths.shape)
    last, _, last_log_det = model.encode(data.at(everyone, data.lengths - 1))
    stationary = stationary_covariance(drift, diffusion)[:, None]
    end = gaussian_log_prob(last, stationary) + last_log_det
    n_transitions = torch.as_tensor(
        np.maximum(data.lengths.mean(1) - pairs[2].mean(1), 1.0), dtype=end.dtype, device=end.device
    )
    return -(conditional.mean(1) + end.mean(1) / n_transitions)


def _reproduction(
    config: ImitationFlowConfig, model: BatchedModel, data: _Recordings, draws: _Draws
) -> Tensor:
    """Squared error of whole reproductions at stratified times, and the tube's: shape (m,)."""
    n = data.n_recordings
    everyone = np.broadcast_to(np.arange(n), (data.n_models, n))
    starts = data.at(everyone, np.zeros_like(everyone))
    offsets = None
    if config.tube_weight:
        noise = torch.as_tensor(draws.normal(n, data.n_dims), device=data.device)
        offsets = config.tube_width * noise
        starts = torch.cat([starts, starts + offsets], dim=1)
    z, attractor, _ = model.encode(starts)
    drift = model.latent.drift()

    def error(z0: Tensor, n_times: int, offset: Tensor | None) -> Tensor:
        strata = (np.arange(n_times) + draws.uniform(n_times)) / n_times
        spans = data.lengths[:, :, None] - 1
        samples = np.minimum(1 + (strata[:, None] * spans).astype(np.int64), spans)
        recordings = np.broadcast_to(everyone[:, :, None], samples.shape).reshape(len(samples), -1)
        samples = samples.reshape(len(samples), -1)
        forward = propagator(drift, data.durations(recordings, samples)).unflatten(1, (n, n_times))
        path = (forward @ z0[:, :, None, :, None])[..., 0].flatten(1, 2)
        target = data.at(recordings, samples)
        if offset is not None:
            left = torch.as_tensor(1 - strata, device=data.device)[:, None, :, None]
            target = target + (offset[:, :, None] * left).flatten(1, 2)
        return (model.flow(path + attractor) - target).square().sum(-1).mean(1)

    loss = error(z[:, :n], config.n_times, None)
    if offsets is not None:
        loss = loss + config.tube_weight * error(z[:, n:], max(config.n_times // 2, 1), offsets)
    return SQUARED_ERROR_WEIGHT * loss


def _calm(
    config: ImitationFlowConfig, model: BatchedModel, data: _Recordings, draws: _Draws
) -> Tensor:
    """Mean log excess of the speed over the demonstrations' peak, in twice their box: (m,)."""
    uniform = torch.as_tensor(draws.uniform(CALM_POINTS, data.n_dims), device=data.device)
    y = data.centre + 2 * data.half * (2 * uniform - 1)
    z, attractor, _ = model.encode(y)
    step = torch.full((data.n_models, 1), CALM_STEP, device=data.device)
    forward = propagator(model.latent.drift(), step)[:, 0]
    moved = model.flow(z @ forward.mT + attractor) - y
    speed = moved.square().sum(-1).add(1e-12).sqrt() / CALM_STEP
    return torch.relu(torch.log(speed / (config.calm_speed * data.peak_speed[:, None]))).mean(1)


def _fit_noise(model: BatchedModel, data: _Recordings, draws: _Draws) -> None:
    """Fit K alone by the forward likelihood, in float64; the flow and A stay as they are."""
    horizon = draws.uniform(NOISE_PAIRS)
    with torch.no_grad():
        pairs = _random_pairs(data, draws, NOISE_PAIRS, horizon)
        before, after, _, _, times = (t.double() for t in _encoded_pairs(model, data, pairs))
        drift = model.latent.drift().double()
        residual = after - (propagator(drift, times) @ before[..., None])[..., 0]
    noise = model.latent.log_noise
    optimizer = torch.optim.Adam([noise], lr=NOISE_RATE)
    for _ in range(NOISE_STEPS):
        _, covariance = transition(drift, model.latent.diffusion().double(), times)
        loss = -gaussian_log_prob(residual, covariance).mean(1)
        optimizer.zero_grad()
        loss.sum().backward()
        optimizer.step()


def _clip_gradients(model: BatchedModel, max_norm: float) -> Tensor:
    """Scale each model's gradient to `max_norm` at most; drop one that is not finite.

    Returns which models' gradients were finite, shape (m,).
    """
    gradients = [(p.grad, axis) for p, axis in model.parameters_by_model() if p.grad is not None]
    norm = torch.stack([_over_models(g.square(), axis) for g, axis in gradients]).sum(0).sqrt()
    finite = norm.isfinite()
    factor = torch.where(finite, max_norm / norm.clamp_min(max_norm), torch.zeros_like(norm))
    for gradient, axis in gradients:
        shape = [1] * gradient.dim()
        shape[axis] = -1
        gradient.masked_fill_(~finite.view(shape), 0.0).mul_(factor.view(shape))
    return finite


def _over_models(values: Tensor, axis: int) -> Tensor:
    return values.sum([i for i in range(values.dim()) if i != axis])


def _finite(model: BatchedModel) -> Tensor:
    """Whether each model's parameters are all finite, shape (m,)."""
    return torch.stack(
        [p.isfinite().movedim(axis, 0).flatten(1).all(1) for p, axis in model.parameters_by_model()]
    ).all(0)
