"""ImitationFlow: learning deep stable stochastic dynamic systems by normalizing flows.

Urain, Ginesi, Tateo & Peters, IROS 2020. The model is eq. (4),

    dz = f(z) dt + g(z) dB,    y = h(z),

a stable stochastic system seen through a normalizing flow h, so that in y it is the stochastic
system of eq. (5) with the Lyapunov function V(y) = U(h^-1(y)) (Lemma 1). f is linear for motions
that end (`latent`) and a limit cycle for motions that repeat (`limit_cycle`).

Deviations from the paper: f is stable by construction instead of by a constraint; transitions are
closed forms instead of Euler steps; the latent attractor is h^-1(x*), so that the goal is the
attractor exactly; the default objective adds the error of whole reproductions (`training`); the
conditioners have one hidden layer of saturating units and bounded log-scales (`coupling`).
"""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iflow_gym.baselines.imitation_flow.calm import Calmness, calmness_of
from iflow_gym.baselines.imitation_flow.config import ImitationFlowConfig
from iflow_gym.baselines.imitation_flow.data import Frame, Task
from iflow_gym.baselines.imitation_flow.emissions import FIELDS, make_field
from iflow_gym.baselines.imitation_flow.export import export
from iflow_gym.baselines.imitation_flow.fields.latents import CycleField, LatentField, LinearField
from iflow_gym.baselines.imitation_flow.guard import Restart, TrainingError, restarts_of
from iflow_gym.baselines.imitation_flow.noise import (
    AdditiveNoise,
    LatentSDE,
    VanishingLinearNoise,
)
from iflow_gym.baselines.imitation_flow.realtime import MeanDynamics, RealTimeStepper
from iflow_gym.baselines.imitation_flow.stochastic import StochasticSystem
from iflow_gym.baselines.imitation_flow.training import Trained, train, train_one
from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.model_files import model_file_errors, read_model_file, write_model_file
from iflow_gym.partial_fits import PartialFitError
from iflow_gym.system import DynamicalSystem, Guarantee, seconds, whole_number

ORTHOGONAL = 1e-6
"""How far R^T R of a rotation in a file may be from the identity: its inverse is taken as R^T."""

AT_REST = 0.02
"""Nearer to the goal than this fraction of the farthest latent state a recording may be at rest."""

KAPPA_HORIZON = 0.02
"""Transitions that vanishing noise is fitted on, as a fraction of a recording."""

INVERSE = 1e-6
"""How far h(h^-1(x*)) may be from x*, in lengths of the motion."""

LATENTS: dict[type[LatentField], tuple[str, ...]] = {
    LinearField: ("drift", "diffusion"),
    CycleField: ("decay", "rate", "radius", "noise"),
}
"""The numbers that each latent system is made of."""


class ImitationFlow(DynamicalSystem):
    """A normalizing flow over a stable stochastic system (see the module).

    `velocity`, `step` and `rollout` are those of the mean dynamics dz = f(z) dt; `step` and
    `rollout` are exact for any dt. `log_prob` and `sample` are those of the stochastic system,
    `trajectory_log_prob` is what classifies whole trajectories.

    Demonstrations that end are learned with a linear latent system, demonstrations that repeat with
    a limit cycle.

    The noise K dB is additive by default: the mean converges to the goal, and the state is
    ultimately bounded around it with a stationary density. It does not come to rest there, since
    L|z|^2 = 2 z^T A z + tr(K K^T) is positive close to the attractor. With ``noise="vanishing"`` it
    does. `guarantee` speaks of the mean.

    `fit_many` trains motions of like counts and dimensions in batches, each from its own seed.
    What trains beside a motion changes the rounding of its sums and nothing else, but training
    amplifies rounding: after a full training a fit is as good and not bit for bit the one alone.
    Where some diverge the others are trained to the end, and `fit_many` raises a `PartialFitError`
    that holds them.

    Attributes
    ----------
    restarts_ : list of Restart
        Where training diverged: the step, and the share of the learning rate it went on with.
    calm_ : Calmness or None
        The fastest speed that was found in twice the recordings' box, in their peak speed, and the
        rounds of training that were added because of it. None where it was not looked at: motions
        that repeat, ``objective="paper"``, ``calm_weight=0``.

    A file keeps both.

    Examples
    --------
    >>> from iflow_gym import load_lasa
    >>> from iflow_gym.baselines.imitation_flow import ImitationFlow
    >>> system = ImitationFlow(n_steps=20).fit(load_lasa("Angle"), seed=0)
    >>> system.velocity([[-40.0, 10.0]]).shape
    (1, 2)
    """

    name: ClassVar[str] = "imitation-flow"
    title: ClassVar[str] = "ImitationFlow"
    Config: ClassVar[type] = ImitationFlowConfig
    integrator: ClassVar[str] = "exact flow"
    learns_cycles: ClassVar[bool] = True
    config: ImitationFlowConfig

    def _fit(self, demonstrations: Demonstrations, rng: np.random.Generator) -> None:
        task = Task([demonstrations])
        self._take(train_one(self.config, task, rng), task)

    def _fit_many(
        self, demonstrations: Sequence[Demonstrations], seeds: Sequence[int]
    ) -> list[Self]:
        tasks = [Task([motion]) for motion in demonstrations]
        alike: dict[tuple[int, int, int, bool], list[int]] = defaultdict(list)
        for i, task in enumerate(tasks):
            alike[task.shape].append(i)
        systems = [type(self)(self.config) for _ in seeds]
        failures: dict[int, Exception] = {}
        for indices in alike.values():
            rngs = [np.random.default_rng(seeds[i]) for i in indices]
            trained = train(self.config, [tasks[i] for i in indices], rngs)
            for i, model in zip(indices, trained, strict=True):
                try:
                    systems[i]._take(model, tasks[i])
                except (TrainingError, ValueError) as error:
                    failures[i] = error
        if failures:
            raise PartialFitError(
                [motion.name for motion in demonstrations],
                [
                    None if i in failures else system._fitted(motion)
                    for i, (system, motion) in enumerate(zip(systems, demonstrations, strict=True))
                ],
                failures,
            )
        return systems

    def _check_demonstrations(self, demonstrations: Demonstrations) -> None:
        super()._check_demonstrations(demonstrations)
        if self.config.noise == "vanishing" and demonstrations.goal is None:
            raise ValueError(
                f"Expected noise='additive' for {demonstrations.name!r}, which repeats: its rounds "
                "cross each other, which noise that vanishes on the cycle excludes."
            )
        if demonstrations.n_dims < 2:
            raise ValueError(
                "Expected a motion in at least 2 dimensions for coupling layers, got 1: use "
                "'linear' or 'gmr', or add a coordinate."
            )

    def _take(self, trained: Trained | TrainingError, task: Task) -> None:
        """Take a trained model over into this system; raise what became of one that is none."""
        if isinstance(trained, TrainingError):
            raise trained
        frame = Frame.of(task)
        arrays: dict[str, NDArray[Any]] = {
            **trained.arrays(),
            "frame": frame.matrix,
            "time": np.array([frame.time]),
        }
        self.restarts_: list[Restart] = trained.restarts
        self.calm_: Calmness | None = trained.calm
        if self.config.noise == "vanishing":
            arrays["kappa"] = np.ones(1)
        self._adopt(arrays, task.origins[0], cyclic=task.cyclic)
        if self.config.noise == "vanishing":
            arrays["kappa"] = np.array([self._likeliest_kappa(task)])
            self._adopt(arrays, task.origins[0], cyclic=task.cyclic)

    def _likeliest_kappa(self, task: Task) -> float:
        """Return the scale of the vanishing noise that fits the recordings' transitions best."""
        pairs = []
        for motion in task.motions:
            for positions, dt in zip(motion.positions, motion.dt, strict=True):
                k = max(1, round(KAPPA_HORIZON * (len(positions) - 1)))
                z, _ = self._encode(positions[::k])
                pairs.append((z[:-1], z[1:], np.full(len(z) - 1, k * dt / self._time)))
        z0, z1, t = (np.concatenate(part) for part in zip(*pairs, strict=True))
        # At the goal there is no noise: recordings that rest there say nothing of it.
        far = np.linalg.norm(z0, axis=1) > AT_REST * np.linalg.norm(z0, axis=1).max()
        z0, z1, t = z0[far], z1[far], t[far]
        assert isinstance(self._latent, LinearField)
        return VanishingLinearNoise.fit(self._latent, z0, z1, t).kappa

    # The mean dynamics --------------------------------------------------------------------

    def _encode(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Latent states relative to the attractor, (n, d), and log |det| of dz/dx, (n,)."""
        z, log_det = self._flow.inverse((x - self._origin) @ self._inverse_frame.T)
        return z - self._attractor, log_det - self._log_volume

    def _decode(self, z: FloatArray) -> FloatArray:
        return self._flow.forward(z + self._attractor) @ self._frame.T + self._origin

    def _velocity(self, x: FloatArray) -> FloatArray:
        if len(x) == 1:
            return self._stepper.velocity(x[0])[None]
        z, _ = self._encode(x)
        _, rate = self._flow.push_forward(z + self._attractor, self._latent.rate(z))
        return rate @ (self._frame.T / self._time)

    def _step(self, x: FloatArray, dt: FloatArray) -> FloatArray:
        if len(x) == 1:
            return self._stepper.step(x[0], dt[0])[None]
        z, _ = self._encode(x)
        return self._decode(self._latent.propagate(z, dt / self._time))

    def _rollout(self, x0: FloatArray, n_steps: int, dt: float) -> FloatArray:
        z, _ = self._encode(x0)
        times = np.arange(1, n_steps + 1, dtype=np.float64) * (dt / self._time)
        path = self._latent.path(z, times)
        decoded = self._decode(path.reshape(-1, x0.shape[1])).reshape(path.shape)
        return np.concatenate([x0[:, None], decoded], axis=1)

    def _lyapunov(self, x: FloatArray) -> FloatArray:
        return self._latent.lyapunov(self._encode(x)[0])

    def _lyapunov_rate(self, x: FloatArray) -> FloatArray:
        return self._latent.lyapunov_rate(self._encode(x)[0]) / self._time

    @property
    def guarantee(self) -> Guarantee:
        """Proved for the mean dynamics: see Lemma 1, `latent` and `limit_cycle`."""
        self._require_fit()
        rate = f"{self._latent.min_decay / self._time:.3g} / s"
        if self.period_ is not None:
            centre = "the cycle's centre" if self.n_dims_ == 2 else "the axis of the cycle"
            return Guarantee(
                "proved",
                "The squared distance V(x) of h^-1(x) to the latent cycle decreases along the mean "
                f"dynamics from every state off the cycle but the image of {centre}, where the "
                "field jumps: h is a diffeomorphism, and the distance decays at "
                f"{rate} at least. With the additive noise the state stays around the cycle in "
                "distribution.",
            )
        return Guarantee(
            "proved",
            "V(x) = |h^-1(x) - h^-1(x*)|^2 decreases along the mean dynamics for every state, "
            "since h is a diffeomorphism and the symmetric part of A is negative definite (slowest "
            f"decay {rate}). {self._noise_statement()}",
        )

    def _noise_statement(self) -> str:
        margin = self._noise.margin / self._time
        if margin > 0:
            return (
                "With the noise, which vanishes at the goal, V decreases at "
                f"{margin:.3g} / s on average: the goal is asymptotically stable in probability."
            )
        if self.config.noise == "vanishing":
            return "The noise vanishes at the goal, but is too strong for V to prove stability."
        return (
            "With the additive noise the mean converges and the state stays bounded around the "
            "goal in distribution."
        )

    # The stochastic system ----------------------------------------------------------------

    def _log_prob(self, x: FloatArray, x_next: FloatArray, dt: float) -> FloatArray:
        before, _ = self._encode(x)
        after, log_det = self._encode(x_next)
        return self._noise.log_prob(before, after, dt / self._time) + log_det

    def stochastic(self) -> StochasticSystem:
        """Return the stochastic system: drift, diffusion, density over time, LV."""
        self._require_fit()
        return StochasticSystem(self._stepper.dynamics, self._noise)

    def stationary_log_prob(self, x: ArrayLike) -> FloatArray:
        """Return log p(x) in the limit of time, shape (...), of the stochastic system.

        Raises ValueError with ``noise="vanishing"``, whose limit is the attractor itself.
        """
        if self.config.noise == "vanishing":
            raise ValueError("Expected noise='additive': vanishing noise has no stationary law.")
        states, shape = self._states(x)
        z, log_det = self._encode(states)
        return (self._latent.stationary_log_prob(z) + log_det).reshape(shape[:-1])

    def trajectory_log_prob(
        self, x: ArrayLike, dt: float, *, stride: int = 1, initial: bool = False
    ) -> float:
        """Return log p(tau), the log density of a trajectory x, shape (T, d), sampled every dt.

        The sum of the transitions' (paper, sec. IV-C: argmax_k p(tau | k) classifies). Every
        `stride`-th sample is taken; with `initial` the first state counts with its stationary
        density.
        """
        states, shape = self._states(x)
        stride = whole_number(stride)
        if len(shape) != 2 or stride < 1 or len(states) <= stride:
            raise ValueError(
                f"Expected a trajectory (T, d) of more than stride = {stride} >= 1 samples, got "
                f"shape {shape}."
            )
        states = states[::stride]
        z, log_det = self._encode(states)
        time = stride * seconds(dt) / self._time
        total = float(np.sum(self._noise.log_prob(z[:-1], z[1:], time) + log_det[1:]))
        if initial:
            total += float(self.stationary_log_prob(states[0]))
        return total

    def sample(
        self, x0: ArrayLike, n_steps: int, dt: float, *, rng: np.random.Generator
    ) -> FloatArray:
        """Draw trajectories of the stochastic system from x0 (..., d).

        The transitions are exact for any dt > 0 (seconds), by Euler-Maruyama in the latent space
        with ``noise="vanishing"``; n_steps is a whole number >= 0. Returns shape
        (..., n_steps + 1, d).
        """
        states, shape = self._states(x0)
        n_steps, time = whole_number(n_steps), seconds(dt) / self._time
        path = np.empty((len(states), n_steps + 1, shape[-1]))
        path[:, 0], _ = self._encode(states)
        for k in range(n_steps):
            path[:, k + 1] = self._noise.sample(path[:, k], time, rng)
        decoded = self._decode(path.reshape(-1, shape[-1])).reshape(path.shape)
        decoded[:, 0] = states
        return decoded.reshape(*shape[:-1], n_steps + 1, shape[-1])

    # Files --------------------------------------------------------------------------------

    def export(self, path: str | os.PathLike[str], *, velocity: bool = True) -> Path:
        """Write the mean dynamics as an ONNX file that runs without this package.

        Inputs ``x`` (n, d) and ``dt`` (n,) or (1,) in seconds, outputs ``x_next`` and ``velocity``
        (n, d), float64; without `velocity` a step takes half the time. See `export` for more.
        Needs the extra ``onnx``.
        """
        self._require_fit()
        reason = self.guarantee
        return export(
            self._stepper.dynamics,
            path,
            velocity=velocity,
            method=self.name,
            guarantee=f"{reason.kind}: {reason.reason}",
            dt_unit="s",
        )

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write a model file, see `Method.save`; the header says what became of its training."""
        target = super().save(path)
        said: dict[str, Any] = {"restarts": self.restarts_} if self.restarts_ else {}
        if self.calm_ is not None:
            said["calm"] = self.calm_
        if said:
            header, arrays = read_model_file(target)
            write_model_file(target, {**header, **said}, arrays)
        return target

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Read a file that `save` wrote; raise ModelFileError if it is anything else."""
        system = super().load(path)
        header, _ = read_model_file(path)
        with model_file_errors(path, cls.name):
            system.restarts_ = restarts_of(header)
            system.calm_ = calmness_of(header)
        return system

    def _arrays(self) -> dict[str, NDArray[Any]]:
        return dict(self._parameters)

    def _restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        self.restarts_, self.calm_ = [], None
        self._adopt(arrays, self.goal_, cyclic=self.period_ is not None)

    def _adopt(
        self, arrays: Mapping[str, NDArray[Any]], origin: FloatArray, *, cyclic: bool
    ) -> None:
        """Take the parameters over and check all that Lemma 1 needs of them."""
        d, kind = len(origin), CycleField if cyclic else LinearField
        vanishing = ("kappa",) if self.config.noise == "vanishing" else ()
        names = (*FIELDS[self.config.emission].NAMES, *LATENTS[kind], "frame", "time", *vanishing)
        parameters = {k: np.asarray(arrays[k], dtype=np.float64) for k in names}
        flow = make_field(self.config, parameters)
        latent = kind(**{name: parameters[name] for name in LATENTS[kind]})
        sizes = [len(parameters["rotation"]), parameters["hidden_bias"].shape[-1]]
        if sizes[0] != self.config.n_layers or sizes[1] > self.config.n_hidden:
            raise ValueError(
                f"expected {self.config.n_layers} layers of {self.config.n_hidden} units, as its "
                f"settings say, got {sizes[0]} of {sizes[1]}"
            )
        rotation, frame, time = (parameters[k] for k in ("rotation", "frame", "time"))
        shapes = [(flow.n_dims,), (latent.n_dims,), frame.shape, time.shape]
        if shapes != (expected := [(d,), (d,), (d, d), (1,)]):
            raise ValueError(
                f"expected flow, latent, frame and time of shapes {expected}, got {shapes}"
            )
        if not time[0] > 0:
            raise ValueError(f"expected a time > 0, got {time}")
        turned = np.linalg.norm(np.swapaxes(rotation, 1, 2) @ rotation - np.eye(d), axis=(1, 2))
        if not (off := turned.max()) <= ORTHOGONAL:
            raise ValueError(f"expected orthogonal rotations, got |R^T R - I| = {off:.3g}")
        if not np.linalg.cond(frame) < 1 / INVERSE:
            raise ValueError(f"expected an invertible frame, got {frame}")
        attractor = flow.inverse(np.zeros((1, d)))[0]
        if not (off := np.abs(flow.forward(attractor)).max()) <= INVERSE:
            raise ValueError(f"expected a flow that inverts at the goal, got an error of {off:.3g}")
        self._noise: LatentSDE = AdditiveNoise(latent)
        if vanishing:
            if not isinstance(latent, LinearField) or parameters["kappa"].shape != (1,):
                raise ValueError(f"expected one kappa for a motion that ends, got {parameters}")
            self._noise = VanishingLinearNoise(latent, float(parameters["kappa"][0]))
        self._parameters, self._flow, self._latent = parameters, flow, latent
        self._attractor = np.zeros((1, d)) if cyclic else attractor
        self._origin, self._frame, self._time = origin, frame, float(time[0])
        self._stepper = RealTimeStepper(
            MeanDynamics(flow, latent, self._attractor[0], origin, frame, self._time)
        )
        self._inverse_frame = np.linalg.inv(frame)
        self._log_volume = float(np.linalg.slogdet(frame)[1])
