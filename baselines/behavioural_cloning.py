"""Behavioural cloning: a neural network of the velocity on the position.

Supervised learning of actions from states (Pomerleau, "Efficient training of artificial neural
networks for autonomous navigation", Neural Computation 3(1), 1991): a multilayer perceptron f with
two hidden layers of tanh units minimises the mean of ‖f(x) - v‖² over the demonstrations' samples,
by Adam with decoupled weight decay (Loshchilov & Hutter, ICLR 2019, algorithm 2). The weights that
are used are an exponential moving average of those that are trained.

How long to train and how much decay to apply are chosen from the fitted demonstrations alone: of
some of them each is left out once, and the number of steps and the decay of least error on what was
left out are used on all. Networks of every demonstration that is left out, every decay and every
motion train together, as one batched network; a network's random numbers do not depend on what
trains beside it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.system import DynamicalSystem, Guarantee

PIECES = 5
"""A single demonstration is cut into so many pieces in time, some of which are left out."""

CHUNK = 50
"""Steps whose samples are drawn at once."""

BETAS, EPSILON = (0.9, 0.999), 1e-8
"""Of Adam."""

Samples = NDArray[np.float32]

LAYERS = ("weights_1", "biases_1", "weights_2", "biases_2", "weights_3", "biases_3")
"""Names of a network's arrays."""


@dataclass(frozen=True)
class BehaviouralCloningConfig:
    """Settings of `BehaviouralCloning`."""

    width: int = 64
    """Units of each of the two hidden layers."""
    decays: tuple[float, ...] = (0.0, 0.01, 0.1)
    """Candidates for the weight decay, a rate that is multiplied by the learning rate."""
    n_left_out: int = 2
    """Demonstrations that are left out, one at a time, to choose the decay and the steps."""
    n_steps: int = 1500
    """Most steps of training."""
    check_every: int = 50
    """Steps between two looks at what was left out; the number of steps is a multiple of it."""
    batch_size: int = 128
    """Samples a step."""
    learning_rate: float = 3e-3
    """Of Adam."""
    averaging: float = 0.99
    """How much of the average stays from step to step."""

    def __post_init__(self) -> None:
        for field in ("width", "n_left_out", "n_steps", "check_every", "batch_size"):
            if getattr(self, field) < 1:
                raise ValueError(f"Expected {field} >= 1, got {getattr(self, field)}.")
        if not self.decays or min(self.decays) < 0:
            raise ValueError(f"Expected at least one decay, all >= 0, got {self.decays}.")
        if not self.learning_rate > 0:
            raise ValueError(f"Expected learning_rate > 0, got {self.learning_rate}.")
        if not 0 <= self.averaging < 1:
            raise ValueError(f"Expected averaging in [0, 1), got {self.averaging}.")


class BehaviouralCloning(DynamicalSystem):
    """A multilayer perceptron that was trained to give the demonstrated velocity.

    Far from the demonstrations the tanh units saturate, and the velocity becomes constant along
    every ray: finite, and not necessarily towards anything.

    Attributes
    ----------
    layers_ : tuple of arrays
        Weights, shape (inputs, outputs), and biases, shape (outputs,), of three layers in turn,
        for positions less `centre_` in units of `length_` and velocities in units of `speed_`.
    decay_ : float
        Weight decay that was chosen; set by `fit`, not by `load`.
    n_steps_ : int
        Steps of training that were chosen; set by `fit`, not by `load`.

    References
    ----------
    Pomerleau, Neural Computation 3(1), 1991; Loshchilov & Hutter, ICLR 2019.

    Examples
    --------
    >>> from iflow_gym import load_lasa
    >>> system = BehaviouralCloning(n_steps=100).fit(load_lasa("Angle"), seed=0)
    >>> system.guarantee.kind
    'none'
    """

    name: ClassVar[str] = "bc"
    title: ClassVar[str] = "Behavioural cloning"
    Config: ClassVar[type] = BehaviouralCloningConfig
    learns_cycles: ClassVar[bool] = True

    def _fit(self, demonstrations: Demonstrations, rng: np.random.Generator) -> None:
        (task,) = _train_all([_Task(demonstrations, rng)], self.config)
        self._adopt_task(task)

    def _fit_many(
        self, demonstrations: Sequence[Demonstrations], seeds: Sequence[int]
    ) -> list[Self]:
        tasks = [
            _Task(d, np.random.default_rng(s)) for d, s in zip(demonstrations, seeds, strict=True)
        ]
        systems = [type(self)(self.config) for _ in tasks]
        by_size: dict[int, list[int]] = {}
        for i, entry in enumerate(demonstrations):
            by_size.setdefault(entry.n_dims, []).append(i)
        for members in by_size.values():  # networks of one batch have as many inputs
            for i, task in zip(
                members, _train_all([tasks[i] for i in members], self.config), strict=True
            ):
                systems[i]._adopt_task(task)
        return systems

    def _adopt_task(self, trained: _Trained) -> None:
        task, self.decay_, self.n_steps_ = trained.task, trained.decay, trained.n_steps
        self._adopt(trained.layers, task.centre, task.length, task.speed)

    def _adopt(
        self, layers: Sequence[FloatArray], centre: FloatArray, length: float, speed: float
    ) -> None:
        self.layers_ = tuple(layers)
        self.centre_, self.length_, self.speed_ = centre, float(length), float(speed)
        # tanh z = 2 sigmoid(2 z) - 1: the network of sigmoids, of offsets in length.
        w1, b1, w2, b2, w3, b3 = self.layers_
        self._sigmoid_layers = (
            *(2 * w1 / self.length_, 2 * b1),
            *(4 * w2, 2 * (b2 - w2.sum(axis=0))),
            *(2 * self.speed_ * w3, self.speed_ * (b3 - w3.sum(axis=0))),
        )

    def _velocity(self, x: FloatArray) -> FloatArray:
        w1, b1, w2, b2, w3, b3 = self._sigmoid_layers
        hidden = _sigmoid((x - self.centre_) @ w1, b1)
        return np.asarray(_sigmoid(hidden @ w2, b2) @ w3 + b3)

    @property
    def guarantee(self) -> Guarantee:
        """None: the network knows nothing of the goal."""
        return Guarantee(
            "none",
            "a regression of velocities: nothing in it keeps the goal an equilibrium, attracts to "
            "it or to an orbit, or says anything of states away from the demonstrations",
        )

    def _arrays(self) -> dict[str, np.ndarray[Any, Any]]:
        # Trained in float32, and exact in it: half the file.
        layers = {k: a.astype(np.float32) for k, a in zip(LAYERS, self.layers_, strict=True)}
        return layers | {"centre": self.centre_, "scales": np.array([self.length_, self.speed_])}

    def _restore(self, arrays: Mapping[str, np.ndarray[Any, Any]]) -> None:
        layers = [np.asarray(arrays[k], dtype=np.float64) for k in LAYERS]
        centre, scales = (np.asarray(arrays[k], dtype=np.float64) for k in ("centre", "scales"))
        d, h = self.n_dims_, self.config.width
        expected = [(d, h), (h,), (h, h), (h,), (h, d), (d,), (d,), (2,)]
        came = [a.shape for a in (*layers, centre, scales)]
        if came != expected:
            raise ValueError(
                f"expected {', '.join(LAYERS)}, centre, scales of shapes {expected}, got {came}"
            )
        if not (scales > 0).all():
            raise ValueError(f"expected scales > 0, got {scales}")
        if not all(np.isfinite(a.astype(np.float32)).all() for a in layers):
            raise ValueError("expected weights that single precision holds, got larger ones")
        self._adopt(layers, centre, *scales)


def _sigmoid(values: FloatArray, biases: FloatArray) -> FloatArray:
    """Replace values by sigmoid(values + biases), and return them."""
    values += biases
    torch.from_numpy(values).sigmoid_()
    return values


# Training -----------------------------------------------------------------------------------


class _Task:
    """One motion's samples, scaled, and its random numbers."""

    def __init__(self, demonstrations: Demonstrations, rng: np.random.Generator) -> None:
        x, v = demonstrations.positions, demonstrations.velocities
        self.centre: FloatArray = np.concatenate(x).mean(axis=0)
        self.length = float(np.sqrt(np.mean((np.concatenate(x) - self.centre) ** 2)))
        self.speed = float(np.sqrt(np.mean(np.concatenate(v) ** 2)))
        self.parts: list[Samples] = [
            np.hstack([(p - self.centre) / self.length, u / self.speed]).astype(np.float32)
            for p, u in zip(x, v, strict=True)
        ]
        if len(self.parts) == 1:
            self.parts = [p for p in np.array_split(self.parts[0], PIECES) if len(p)]
        self.seed = int(rng.integers(2**31))

    def left_out(self, n: int) -> list[int]:
        """Return which parts are left out, spread over all of them."""
        spread = np.linspace(0, len(self.parts) - 1, min(n, len(self.parts)) + 2)[1:-1]
        return sorted({round(i) for i in spread})

    def without(self, out: int | None) -> Samples:
        """Return the samples of all parts but one, shape (n, 2 d)."""
        return np.concatenate([p for i, p in enumerate(self.parts) if i != out])


class _Trained(NamedTuple):
    task: _Task
    layers: list[FloatArray]
    decay: float
    n_steps: int


class _Job(NamedTuple):
    """One network of a batch."""

    samples: Samples
    decay: float
    seed: int


def _train_all(tasks: Sequence[_Task], config: BehaviouralCloningConfig) -> list[_Trained]:
    """Choose the decay and the number of steps of each task, and train it on all its samples."""
    trials = [
        (i, out, decay)
        for i, task in enumerate(tasks)
        for out in task.left_out(config.n_left_out)
        for decay in config.decays
    ]
    jobs = [_Job(tasks[i].without(out), decay, tasks[i].seed) for i, out, decay in trials]
    held = [tasks[i].parts[out] for i, out, _ in trials]
    checks = [*range(config.check_every, config.n_steps + 1, config.check_every)]
    checks = checks or [config.n_steps]
    curves = np.zeros((len(tasks), len(config.decays), len(checks)))
    for column, network in enumerate(_train(jobs, checks, config)):
        errors = network.errors(held)
        for (i, _, decay), error in zip(trials, errors, strict=True):
            curves[i, config.decays.index(decay), column] += error
    best = [np.unravel_index(int(c.argmin()), c.shape) for c in curves]
    chosen = [(config.decays[d], checks[k]) for d, k in best]
    finals = [
        _Job(task.without(None), decay, task.seed)
        for task, (decay, _) in zip(tasks, chosen, strict=True)
    ]
    trained: dict[int, list[FloatArray]] = {}
    stops = sorted({n for _, n in chosen})
    for stop, network in zip(stops, _train(finals, stops, config), strict=True):
        for i, (_, n) in enumerate(chosen):
            if n == stop:
                trained[i] = network.layers(i)
    return [_Trained(t, trained[i], *chosen[i]) for i, t in enumerate(tasks)]


class _Network:
    """A batch of averaged networks, each tensor with the network as its first axis."""

    def __init__(self, tensors: Sequence[Tensor]) -> None:
        self.tensors = tensors

    def errors(self, samples: Sequence[Samples]) -> list[float]:
        """Return each network's mean squared error on its own samples, shape (n, 2 d)."""
        longest = max(len(s) for s in samples)
        padded = torch.zeros(len(samples), longest, samples[0].shape[1])
        weights = torch.zeros(len(samples), longest, 1)
        for i, s in enumerate(samples):
            padded[i, : len(s)] = torch.from_numpy(s)
            weights[i, : len(s)] = 1 / len(s)
        x, v = padded.chunk(2, dim=2)
        with torch.no_grad():
            squares = weights * (_forward(self.tensors, x) - v) ** 2
        errors: list[float] = squares.sum(dim=(1, 2)).tolist()
        return errors

    def layers(self, i: int) -> list[FloatArray]:
        """Return network i's arrays, in float64; biases without the axis of the samples."""
        arrays = [t[i].numpy().astype(np.float64) for t in self.tensors]
        return [a[0] if k % 2 else a for k, a in enumerate(arrays)]


def _forward(tensors: Sequence[Tensor], x: Tensor) -> Tensor:
    w1, b1, w2, b2, w3, b3 = tensors
    hidden = torch.tanh(torch.baddbmm(b1, x, w1))
    return torch.baddbmm(b3, torch.tanh(torch.baddbmm(b2, hidden, w2)), w3)


def _train(
    jobs: Sequence[_Job], stops: Sequence[int], config: BehaviouralCloningConfig
) -> Iterator[_Network]:
    """Train a network for each job and yield the averaged ones after each number of steps."""
    d = jobs[0].samples.shape[1] // 2
    generators = [np.random.default_rng(job.seed) for job in jobs]
    weights = zip(*(_initial(d, config.width, g) for g in generators), strict=True)
    layers = [torch.from_numpy(np.stack(w)) for w in weights]
    numbers = _flat(layers)
    tensors = [t.detach().requires_grad_() for t in _views(numbers, layers)]
    average, first, second = (torch.zeros_like(numbers) for _ in range(3))
    decay = config.learning_rate * torch.tensor([job.decay for job in jobs])[:, None, None]
    # Biases, the odd ones, do not decay.
    shrink = _flat([torch.ones_like(t) - (k % 2 == 0) * decay for k, t in enumerate(layers)])
    longest = max(len(job.samples) for job in jobs)
    data = torch.zeros(len(jobs), longest, 2 * d)
    for i, job in enumerate(jobs):
        data[i, : len(job.samples)] = torch.from_numpy(job.samples)
    rows = torch.arange(len(jobs))[:, None]
    done = 0
    for stop in stops:
        while done < stop:
            n = min(CHUNK, stop - done)
            drawn = [
                g.integers(len(job.samples), size=(n, config.batch_size))
                for g, job in zip(generators, jobs, strict=True)
            ]
            for picked in torch.from_numpy(np.stack(drawn, axis=1)):
                x, v = data[rows, picked].chunk(2, dim=2)
                loss = ((_forward(tensors, x) - v) ** 2).sum() / config.batch_size
                gradient = _flat(torch.autograd.grad(loss, tensors))
                done += 1
                _adam(numbers, gradient, first, second, done, config.learning_rate, shrink)
                average.lerp_(numbers, 1 - config.averaging)
        yield _Network(_views(average / (1 - config.averaging**done), layers))


def _flat(tensors: Sequence[Tensor]) -> Tensor:
    """Return each network's numbers in one row, shape (networks, size)."""
    return torch.cat([t.flatten(1) for t in tensors], dim=1)


def _views(numbers: Tensor, like: Sequence[Tensor]) -> list[Tensor]:
    """Return the parts of rows as tensors of the shapes of others, which `_flat` put in rows."""
    parts = torch.split_with_sizes(numbers, [t[0].numel() for t in like], dim=1)
    return [part.view(t.shape) for part, t in zip(parts, like, strict=True)]


def _initial(d: int, width: int, rng: np.random.Generator) -> list[Samples]:
    """Return a network's first weights, uniform with the variance 1 / inputs, and biases."""
    sizes = [(d, width), (width, width), (width, d)]
    layers = []
    for inputs, outputs in sizes:
        reach = np.sqrt(3 / inputs)
        layers.append(rng.uniform(-reach, reach, size=(inputs, outputs)).astype(np.float32))
        # The first layer's tanh units bend in different places, so that a line will do as input.
        spread = 1.0 if inputs == d else 0.0
        layers.append(rng.uniform(-spread, spread, size=(1, outputs)).astype(np.float32))
    return layers


def _adam(
    numbers: Tensor,
    gradient: Tensor,
    first: Tensor,
    second: Tensor,
    step: int,
    rate: float,
    shrink: Tensor,
) -> None:
    """Take a step of Adam with decoupled decay; all tensors are of one shape."""
    first.lerp_(gradient, 1 - BETAS[0])
    second.lerp_(gradient**2, 1 - BETAS[1])
    numbers.mul_(shrink)
    root = (second / (1 - BETAS[1] ** step)).sqrt_().add_(EPSILON)
    numbers.addcdiv_(first, root, value=-rate / (1 - BETAS[0] ** step))
