"""Training many ImitationFlows as batched models.

Positions are relative to the goal, in one unit of length a motion (`data.Frame`); times are divided
by the mean duration of the motion's recordings. The objectives are those of
`ImitationFlowConfig.objective`:

"paper"
    Algorithm 1: backward conditionals p(y_i | y_{i+dT}) for random sampling times dT, and the
    stationary density at the last sample (eqs. 6 and 7, with the latent densities of sec. III-B
    in closed form). The backward conditional is the paper's N(F^-1 z', F^-1 Sigma F^-T): the
    reverse under a flat prior on z, not under the stationary density.

"reproduction"
    First the forward conditional likelihood p(y_{i+k} | y_i) over horizons k, log-uniform up to
    60 % of the recording. Then the reproduction itself: from a recording's first sample
    y^(t) = h(exp(A t) h^-1(y_0)) in closed form, squared error to y(t) at random times t and at the
    end, with the likelihood kept at a small weight. Two penalties shape the field beside the data,
    the tube and the calm, see the configuration. Last, with the flow and A fixed, the noise is
    fitted by the same likelihood.

For a motion that repeats, "reproduction" is the forward likelihood alone, over horizons up to one
period, with the density of the state beside it: tempo varies from round to round, and a squared
error over a round would shrink the orbit. With an `orbit_weight` a second stage holds the orbit to
what the recordings have in common, as precisely as they agree (`mean_orbit`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from joblib import Parallel, delayed
from numpy.typing import NDArray
from torch import Tensor, nn

from iflow_gym.baselines.imitation_flow.calm import Calm, Calmness, Sampling
from iflow_gym.baselines.imitation_flow.config import ImitationFlowConfig, Resolved
from iflow_gym.baselines.imitation_flow.coupling import CouplingFlow
from iflow_gym.baselines.imitation_flow.data import Draws, Recordings, Task
from iflow_gym.baselines.imitation_flow.emissions import make_flow
from iflow_gym.baselines.imitation_flow.flow import Flow
from iflow_gym.baselines.imitation_flow.guard import (
    TOLERANCE,
    Adam,
    GuardedAdam,
    Restart,
    TrainingError,
)
from iflow_gym.baselines.imitation_flow.inward import N_STATES, Inward
from iflow_gym.baselines.imitation_flow.latent import INITIAL_DECAY, Latent, LinearLatent
from iflow_gym.baselines.imitation_flow.limit_cycle import LimitCycleLatent
from iflow_gym.baselines.imitation_flow.mean_orbit import MeanOrbit
from iflow_gym.baselines.imitation_flow.objectives import (
    backward_likelihood,
    forward_likelihood,
    pairs_of,
    random_pairs,
    reproduction,
    stationary,
    tube,
)
from iflow_gym.baselines.imitation_flow.passes import Term, encode, evaluate
from iflow_gym.baselines.imitation_flow.whole_step import (
    Preparation,
    Weights,
    WholeStep,
    by_hand,
)

SQUARED_ERROR_WEIGHT = 300.0
"""Weight of the squared error, against which the penalties are measured."""

GROUP = 8
"""So many models train as one batch where the step is by hand: of more, what they work on does not
stay in a processor's cache."""

N_HORIZONS = 14
"""Sampling times in a step's likelihood."""

TURNS = 4
"""The likelihood and the tube take their turns beside the reproduction, one each in so many steps,
with so many times the weight: that trains as well, in less time."""

CALM_ENDS, CALM_CYCLES = Sampling(n_points=64, step=0.001), Sampling(n_points=32, step=0.005)
"""What the calm penalty looks at, where motions end and where they repeat."""

N_WATCHES = 40
"""Sweeps for fast places in the training of motions that end."""

CALM_ROUNDS, CALM_SHARE, CALM_RATE = 6, 0.05, 0.3
"""A model that is loud at the end is trained on, alone, in so many rounds at most, each of a share
of the steps and with a share of the rate."""

N_SWEEPS = 16
"""Lattices that say whether a model is loud at the end."""

ORBIT_FRACTION = 0.3
"""Share of a cycle's steps that maximise the likelihood alone before its orbit counts."""

LIKELIHOOD, WHOLE, ORBIT = 0, 1, 2
"""Stages: losses are of one kind within each."""

NOISE_STEPS = 100
NOISE_HORIZONS = 100
NOISE_PAIRS = 20
NOISE_RATE = 0.1
NOISE_DECAY = 0.9


@dataclass(frozen=True)
class Trained:
    """A trained model: its place in a batch, which is on the CPU."""

    flow: Flow
    latent: Latent
    place: int
    restarts: list[Restart]
    """How often training diverged and was taken back."""
    calm: Calmness | None = None
    """How calm it is, where that was looked at."""

    def arrays(self, context: Tensor | None = None) -> dict[str, NDArray[np.float64]]:
        """Return the numbers of the flow, a context (k,) folded in, and of the latent system."""
        return {**self.flow.arrays(self.place, context), **self.latent.arrays(self.place)}


def train(
    config: ImitationFlowConfig, tasks: Sequence[Task], rngs: Sequence[np.random.Generator]
) -> list[Trained | TrainingError]:
    """Train one model for each task and generator; return them in their order, on the CPU.

    The tasks have as many recordings, dimensions and context numbers each, and all end or all
    repeat. A model whose training diverges again and again is returned as an error, to be raised
    or collected: the others are trained to the end.

    A batch takes one thread: its tensors are small, and threads that wait for each other within an
    operation made a fit ten times as slow on a busy machine. With `n_jobs` the models are dealt out
    to as many processes: threads of one process would wait for each other's Python.
    """
    n_batches = min(config.n_jobs, len(tasks))
    dealt = [range(k, len(tasks), n_batches) for k in range(n_batches)]
    batches = Parallel(n_batches)(
        delayed(_train)(config, [tasks[i] for i in indices], [rngs[i] for i in indices])
        for indices in dealt
    )
    order = [i for indices in dealt for i in indices]
    models = [model for models in batches for model in models]
    return [model for _, model in sorted(zip(order, models, strict=True), key=lambda pair: pair[0])]


def train_one(config: ImitationFlowConfig, task: Task, rng: np.random.Generator) -> Trained:
    """Train one model; raise `TrainingError` where training diverges again and again."""
    (trained,) = train(config, [task], [rng])
    if isinstance(trained, TrainingError):
        raise trained
    return trained


@contextmanager
def _one_thread() -> Iterator[None]:
    n_threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(n_threads)


def _train(
    config: ImitationFlowConfig, tasks: Sequence[Task], rngs: Sequence[np.random.Generator]
) -> list[Trained | TrainingError]:
    device = torch.device(
        ("cuda" if torch.cuda.is_available() else "cpu")
        if config.device == "auto"
        else config.device
    )
    n_groups = 1
    if by_hand(config, tasks[0], device):
        n_groups = math.ceil(len(tasks) / GROUP)
    found: list[Trained | TrainingError] = []
    # What overflows is noticed by its loss.
    with _one_thread(), np.errstate(all="ignore"):
        for group in np.array_split(np.arange(len(tasks)), n_groups):
            mine = [tasks[i] for i in group], [rngs[i] for i in group]
            found += _train_batch(config, *mine, device)
    return found


def _train_batch(
    config: ImitationFlowConfig,
    tasks: Sequence[Task],
    rngs: Sequence[np.random.Generator],
    device: torch.device,
) -> list[Trained | TrainingError]:
    generators = [torch.Generator().manual_seed(int(rng.integers(2**63))) for rng in rngs]
    batch = _Batch(config, tasks, rngs, generators, device)
    n_steps, calm = batch.resolved.n_steps, batch.watched
    adam = batch.optimizer(n_steps, config.learning_rate)
    every = max(1, n_steps // N_WATCHES)
    for step in range(n_steps):
        if calm is not None and step and step % every == 0:
            calm.watch(batch.flow, batch.latent)
        batch.step(adam, step, _stage(config, step, batch.data))
        if len(adam.failures) == len(tasks):
            return [adam.failures[m] for m in range(len(tasks))]
    adam.finish(n_steps, TOLERANCE if batch.bends else 1.0)
    calmness: list[Calmness | None] = [None] * len(tasks)
    if calm is not None:
        speeds = calm.watch(batch.flow, batch.latent, N_SWEEPS)
        for m, speed in enumerate(speeds.tolist()):
            calmness[m] = Calmness(speed, 0)
            if bool(calm.loud(speeds)[m]) and m not in adam.failures:
                alone = _Batch(config, [tasks[m]], [rngs[m]], [generators[m]], device)
                alone.take(batch, m)
                slowed = adam.restarts[m][-1].rate if adam.restarts[m] else 1.0
                calmness[m], restarts = _calm_down(config, alone, n_steps, CALM_RATE * slowed)
                adam.restarts[m] += restarts
                alone.give(batch, m)
    if _stage(config, n_steps, batch.data) == WHOLE:
        _fit_noise(batch.flow, batch.latent, batch.data, rngs)
    flow, latent = batch.flow.to("cpu"), batch.latent.to("cpu")
    return [
        adam.failures.get(m) or Trained(flow, latent, m, adam.restarts[m], calmness[m])
        for m in range(len(tasks))
    ]


class _Batch:
    """Models that train together, and what a step of theirs needs."""

    def __init__(
        self,
        config: ImitationFlowConfig,
        tasks: Sequence[Task],
        rngs: Sequence[np.random.Generator],
        generators: list[torch.Generator],
        device: torch.device,
    ) -> None:
        self._config, self._names = config, [task.name for task in tasks]
        self.data = data = Recordings(tasks, device)
        self.resolved = resolved = _resolved(config, data)
        sizes = (data.n_dims, tasks[0].n_context)
        self.flow = make_flow(config, *sizes, generators, cyclic=data.cyclic).to(device)
        self.latent = _make_latent(config, tasks).to(device)
        self._draws = Draws(rngs, _numbers_a_step(config, data), device)
        self._calm: Calm | None = None
        if resolved.calm_weight and config.objective == "reproduction":
            sampling = CALM_CYCLES if data.cyclic else CALM_ENDS
            self._calm = Calm(data, sampling, config.calm_speed)
        held = _stage(config, resolved.n_steps, data) == ORBIT
        self._orbit: MeanOrbit | None = None
        if held:
            self._orbit = MeanOrbit(tasks, data, config.orbit_resolution)
        self._whole: WholeStep | None = None
        if by_hand(config, tasks[0], device):
            assert isinstance(self.flow, CouplingFlow)
            assert isinstance(self.latent, LinearLatent)
            assert self._calm is not None
            looked_at = N_HORIZONS, _n_pairs(config), self._calm.n_new
            prepared = Preparation(config, data, rngs, *looked_at)
            self._whole = WholeStep(self.flow, self.latent, data, self._calm, prepared, config)
        self._inward: Inward | None = None
        if held and resolved.inward_weight > 0:
            self._inward = Inward(data)

    @property
    def watched(self) -> Calm | None:
        """The calm of motions that end, whose weight grows with need."""
        return None if self.data.cyclic else self._calm

    @property
    def bends(self) -> bool:
        """Whether the last stage bends the way back inwards, at the cost of what is judged."""
        return self._inward is not None

    @property
    def parameters(self) -> list[tuple[nn.Parameter, int]]:
        """All parameters, with the axis that counts the models."""
        return [
            *((p, 1) for p in self.flow.parameters()),
            *((p, 0) for p in self.latent.parameters()),
        ]

    def optimizer(self, n_steps: int, learning_rate: float) -> GuardedAdam:
        """Return an optimizer of all parameters."""
        return GuardedAdam(
            self.parameters,
            self._names,
            n_steps=n_steps,
            learning_rate=learning_rate,
            max_norm=self._config.max_gradient_norm,
        )

    def step(self, adam: GuardedAdam, step: int, stage: int) -> None:
        """Take one step of a stage."""
        weights = _weights(self._config, self.resolved, step, stage)
        adam.begin(step, stage)
        if self._whole is not None:
            adam.descend(step, self._whole(weights, adam.gradients))
            return
        self._draws.new_step()
        terms = _terms(self._config, weights, self.latent, self.data, self._draws)
        calm, calm_weight = self._calm, self.resolved.calm_weight
        if calm is not None:
            terms.append((calm_weight, calm(self._draws)))
        if self._orbit is not None and stage == ORBIT:
            assert isinstance(self.latent, LimitCycleLatent)
            terms.append((self.resolved.orbit_weight, self._orbit(self.latent)))
        inward = self._inward is not None and stage == ORBIT
        if self._inward is not None and inward:
            terms.append((self.resolved.inward_weight, self._inward(self._draws)))
        losses = evaluate(self.flow, self.latent, self.data, [term for _, term in terms])
        weighted = [w * x for (w, _), x in zip(terms, losses, strict=True)]
        judged = loss = torch.stack(weighted).sum(0)
        if calm is not None and calm.raised:
            # Motions that are watched end, and the calm is the last of their terms.
            loss = loss + (calm.weight - 1) * weighted[-1]
        if inward:  # it looks for the worst states: no measure of how training goes
            judged = judged - weighted[-1]
        adam.step(step, loss, judged=judged)

    def take(self, other: _Batch, model: int) -> None:
        """Become one model of another batch."""
        for (mine, axis), (theirs, _) in zip(self.parameters, other.parameters, strict=True):
            mine.data.copy_(theirs.data.narrow(axis, model, 1))
        if self._calm is not None and other._calm is not None:
            self._calm.weight = other._calm.weight[model : model + 1]
            self._calm.raised = True

    def give(self, other: _Batch, model: int) -> None:
        """Put the only model of this batch in its place in another one."""
        for (mine, axis), (theirs, _) in zip(self.parameters, other.parameters, strict=True):
            theirs.data.narrow(axis, model, 1).copy_(mine.data)


def _calm_down(
    config: ImitationFlowConfig, batch: _Batch, n_steps: int, rate: float
) -> tuple[Calmness, list[Restart]]:
    """Train one model on after n_steps, with the weight of its calm doubled from round to round.

    Alone, so that neither its random numbers nor its neighbours' depend on each other. The rate is
    a fraction of the learning rate, and falls where training diverges.
    """
    calm, more = batch.watched, math.ceil(CALM_SHARE * n_steps)
    assert calm is not None
    speeds, rounds = calm.watch(batch.flow, batch.latent, N_SWEEPS), 0
    restarts: list[Restart] = []
    while rounds < CALM_ROUNDS and bool(calm.loud(speeds)):
        adam = batch.optimizer(more, rate * config.learning_rate)
        for step in range(n_steps + rounds * more, n_steps + (rounds + 1) * more):
            batch.step(adam, step, _stage(config, n_steps, batch.data))
        adam.look(n_steps + (rounds + 1) * more)
        restarts += [Restart(step, rate * share) for step, share in adam.restarts[0]]
        rate = restarts[-1].rate if adam.restarts[0] else rate
        rounds += 1
        speeds = calm.watch(batch.flow, batch.latent, N_SWEEPS)
    return Calmness(float(speeds), rounds), restarts


def _make_latent(config: ImitationFlowConfig, tasks: Sequence[Task]) -> Latent:
    n, d, cyclic = len(tasks), tasks[0].n_dims, tasks[0].cyclic
    min_decay = config.resolved(cyclic=cyclic, n_dims=d).min_decay
    if not cyclic:
        return LinearLatent(n, d, min_decay=min_decay)
    latent = LimitCycleLatent(n, d, min_decay=min_decay)
    # Times are in periods, by the main frequency, and the frame makes the first axes a circle.
    rates = torch.tensor([2 * math.pi * task.turns for task in tasks])
    latent.initialise(rates, max(INITIAL_DECAY, 2 * min_decay), 1.0)
    return latent


# What a step minimises --------------------------------------------------------------------


def _weights(config: ImitationFlowConfig, resolved: Resolved, step: int, stage: int) -> Weights:
    """Return the weights of a step's terms."""
    if stage != WHOLE:
        return Weights(1.0, 0.0, 0.0, resolved.calm_weight)
    turn = step % TURNS
    return Weights(
        TURNS * config.likelihood_weight * (turn == 0),
        SQUARED_ERROR_WEIGHT,
        TURNS * SQUARED_ERROR_WEIGHT * config.tube_weight * (turn == TURNS // 2),
        resolved.calm_weight,
    )


def _terms(
    config: ImitationFlowConfig,
    weights: Weights,
    latent: Latent,
    data: Recordings,
    draws: Draws,
) -> list[tuple[float, Term]]:
    """Return the weighted terms of a step, but for the calm and the orbit."""
    q, p = N_HORIZONS, _n_pairs(config)
    if config.objective == "paper":
        return [(1.0, backward_likelihood(latent, data, draws, q, p))]
    terms: list[tuple[float, Term]] = []
    if weights.likelihood:
        terms.append((weights.likelihood, forward_likelihood(latent, data, draws, q, p)))
    if data.cyclic:
        terms.append((1.0, stationary(latent, data, draws, q * p)))
    if weights.reproduction:
        error = reproduction(
            data,
            draws,
            config.n_times,
            power=config.error_power,
            timing_weight=config.timing_weight,
            end_weight=config.end_weight,
        )
        terms.append((weights.reproduction, error))
    if weights.tube:
        beside = tube(data, draws, max(config.n_times // 2, 1), width=config.tube_width)
        terms.append((weights.tube, beside))
    return terms


def _n_pairs(config: ImitationFlowConfig) -> int:
    """Return the pairs of a horizon in a step's likelihood."""
    return max(1, config.n_pairs // N_HORIZONS)


def _stage(config: ImitationFlowConfig, step: int, data: Recordings) -> int:
    """Whether a step minimises the likelihood, whole reproductions, or the orbit's error too."""
    if config.objective == "paper":
        return LIKELIHOOD
    resolved = _resolved(config, data)
    if data.cyclic:
        held = resolved.orbit_weight > 0
        return ORBIT if held and step >= ORBIT_FRACTION * resolved.n_steps else LIKELIHOOD
    return WHOLE if step >= config.likelihood_fraction * resolved.n_steps else LIKELIHOOD


def _resolved(config: ImitationFlowConfig, data: Recordings) -> Resolved:
    return config.resolved(cyclic=data.cyclic, n_dims=data.n_dims)


def _numbers_a_step(config: ImitationFlowConfig, data: Recordings) -> int:
    """Return how many random numbers a step draws at most."""
    n, d = data.n_recordings, data.n_dims
    pairs = N_HORIZONS * _n_pairs(config)
    return (
        2 * N_HORIZONS
        + 3 * pairs
        + 2 * config.n_times
        + d * n
        + (d + 1) * (CALM_CYCLES.n_points + N_STATES if data.cyclic else CALM_ENDS.n_points)
    )


def _fit_noise(
    flow: Flow, latent: Latent, data: Recordings, rngs: Sequence[np.random.Generator]
) -> None:
    """Fit the noise alone by the forward likelihood; the flow and the drift stay as they are."""
    draws = Draws(rngs, NOISE_HORIZONS * (NOISE_PAIRS + 2), data.device)
    draws.new_step()
    latent.requires_grad_(False)
    latent.log_noise.requires_grad_(True)
    points, times = pairs_of(data, *random_pairs(data, draws, NOISE_HORIZONS, NOISE_PAIRS))
    with torch.no_grad():
        z = encode(flow, data, points).z.unflatten(-1, (2, NOISE_HORIZONS, NOISE_PAIRS))
    before, after = z.unbind(2)
    noise = latent.log_noise
    adam = Adam(noise.data)
    for _ in range(NOISE_STEPS):
        loss = -latent.transition_log_prob(before, after, times).mean((1, 2))
        (gradient,) = torch.autograd.grad(loss.sum(), noise)
        adam.step(gradient, NOISE_RATE, NOISE_DECAY)
