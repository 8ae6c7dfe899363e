"""ImitationFlow: learning deep stable stochastic dynamic systems by normalizing flows.

Urain, Ginesi, Tateo & Peters, IROS 2020. The model is eq. (4),

    dz = A z dt + K dB,    y = h(z),

a stable linear stochastic system seen through a normalizing flow h, so that in y it is the
stochastic system of eq. (5) with the Lyapunov function V(y) = U(h^-1(y)) (Lemma 1).

Deviations from the paper: A is stable by construction instead of by a constraint; transitions are
closed forms instead of Euler steps; the latent attractor is h^-1(x*), so that the goal is the
attractor exactly; the default objective adds the error of whole reproductions (`training`); the
conditioners have one hidden layer of saturating units and bounded log-scales (`flow`).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from iflow_gym.baselines.imitation_flow.config import ImitationFlowConfig
from iflow_gym.baselines.imitation_flow.field import NAMES, Flow, Latent
from iflow_gym.baselines.imitation_flow.training import BatchedModel, Scales, train
from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.system import (
    DynamicalSystem,
    Guarantee,
    check_positive_definite,
    seconds,
    whole_number,
)

ORTHOGONAL = 1e-6
"""How far R^T R of a rotation in a file may be from the identity: its inverse is taken as R^T."""

INVERSE = 1e-6
"""How far h(h^-1(x*)) may be from x*, in lengths of the motion."""


class ImitationFlow(DynamicalSystem):
    """A normalizing flow over a stable linear stochastic system (see the module).

    `velocity`, `step` and `rollout` are those of the mean dynamics dz = A z dt; `step` and
    `rollout` are exact for any dt. `log_prob` and `sample` are those of the stochastic system.

    The noise K dB is additive: the mean converges to the goal, and the state is ultimately bounded
    around it with a stationary density. It does not come to rest there, since L|z|^2 =
    2 z^T A z + tr(K K^T) is positive close to the attractor. `guarantee` speaks of the mean.

    `fit_many` trains motions of like counts and dimensions in one batch, each from its own seed.
    What trains beside a motion changes the rounding of its sums and nothing else, but training
    amplifies rounding: after a full training a fit is as good and not bit for bit the one alone.

    Examples
    --------
    >>> from iflow_gym import load_lasa
    >>> from iflow_gym.baselines.imitation_flow import ImitationFlow
    >>> system = ImitationFlow(n_steps=20).fit(load_lasa("Angle"), seed=0)
    >>> system.velocity([[-40.0, 10.0]]).shape
    (1, 2)
    """

    name = "imitation-flow"
    title = "ImitationFlow"
    Config = ImitationFlowConfig
    integrator = "exact flow"
    config: ImitationFlowConfig

    def _fit(self, demonstrations: Demonstrations, rng: np.random.Generator) -> None:
        self._take(train(self.config, [demonstrations], [rng]), 0, demonstrations)

    def _fit_many(
        self, demonstrations: Sequence[Demonstrations], seeds: Sequence[int]
    ) -> list[Self]:
        alike: dict[tuple[int, int], list[int]] = defaultdict(list)
        for i, motion in enumerate(demonstrations):
            alike[len(motion), motion.n_dims].append(i)
        systems = [type(self)(self.config) for _ in seeds]
        for indices in alike.values():
            rngs = [np.random.default_rng(seeds[i]) for i in indices]
            model = train(self.config, [demonstrations[i] for i in indices], rngs)
            for place, i in enumerate(indices):
                systems[i]._take(model, place, demonstrations[i])
        return systems

    def _check_demonstrations(self, demonstrations: Demonstrations) -> None:
        super()._check_demonstrations(demonstrations)
        if demonstrations.n_dims < 2:
            raise ValueError(
                "Expected a motion in at least 2 dimensions for coupling layers, got 1: use "
                "'linear' or 'gmr', or add a coordinate."
            )

    def _take(self, model: BatchedModel, place: int, demonstrations: Demonstrations) -> None:
        """Take one model of a trained batch over into this system."""
        scales = Scales.of(demonstrations)
        flow = model.flow
        with torch.no_grad():
            tensors = {
                "rotation": flow.orthogonal()[:, place],
                "hidden_weight": flow.hidden_weight[:, place],
                "hidden_bias": flow.hidden_bias[:, place],
                "out_weight": flow.out_weight[:, place],
                "out_bias": flow.out_bias[:, place],
                "drift": model.latent.drift()[place],
                "diffusion": model.latent.diffusion()[place],
            }
        arrays: dict[str, NDArray[Any]] = {
            k: t.detach().double().numpy() for k, t in tensors.items()
        }
        arrays["rotation"] = _nearest_orthogonal(arrays["rotation"])
        arrays["scales"] = np.array([scales.length, scales.time])
        self._adopt(arrays, demonstrations.n_dims)

    # The mean dynamics --------------------------------------------------------------------

    def _encode(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Latent states relative to the attractor, (n, d), and log |det| of dz/dx, (n,)."""
        z, log_det = self._flow.inverse((x - self.goal_) / self._length)
        return z - self._attractor, log_det - x.shape[1] * np.log(self._length)

    def _decode(self, z: FloatArray) -> FloatArray:
        return self._flow.forward(z + self._attractor) * self._length + self.goal_

    def _velocity(self, x: FloatArray) -> FloatArray:
        z, _ = self._encode(x)
        _, rate = self._flow.push_forward(z + self._attractor, z @ self._latent.drift.T)
        return rate * (self._length / self._time)

    def _step(self, x: FloatArray, dt: FloatArray) -> FloatArray:
        z, _ = self._encode(x)
        forward = self._latent.propagators(dt / self._time)
        return self._decode((forward @ z[..., None])[..., 0])

    def _rollout(self, x0: FloatArray, n_steps: int, dt: float) -> FloatArray:
        z, _ = self._encode(x0)
        times = np.arange(1, n_steps + 1, dtype=np.float64) * (dt / self._time)
        forward = self._latent.propagators(times)
        path = np.einsum("tij,nj->nti", forward, z)
        decoded = self._decode(path.reshape(-1, x0.shape[1])).reshape(path.shape)
        return np.concatenate([x0[:, None], decoded], axis=1)

    def _lyapunov(self, x: FloatArray) -> FloatArray:
        z, _ = self._encode(x)
        return np.sum(z * z, axis=1)

    def _lyapunov_rate(self, x: FloatArray) -> FloatArray:
        z, _ = self._encode(x)
        return 2 * np.einsum("ni,ij,nj->n", z, self._latent.symmetric, z) / self._time

    @property
    def guarantee(self) -> Guarantee:
        """Proved for the mean dynamics, for every state: see Lemma 1 and `latent`."""
        self._require_fit()
        return Guarantee(
            "proved",
            "V(x) = |h^-1(x) - h^-1(x*)|^2 decreases along the mean dynamics for every state, "
            "since h is a diffeomorphism and the symmetric part of A is negative definite (largest "
            f"eigenvalue {np.linalg.eigvalsh(self._latent.symmetric).max() / self._time:.3g} / s). "
            "With the additive noise the mean converges and the state stays bounded around the "
            "goal in distribution.",
        )

    # The stochastic system ----------------------------------------------------------------

    def _log_prob(self, x: FloatArray, x_next: FloatArray, dt: float) -> FloatArray:
        before, _ = self._encode(x)
        after, log_det = self._encode(x_next)
        forward, covariance = self._latent.transition(dt / self._time)
        residual = after - before @ forward.T
        white = np.linalg.solve(np.linalg.cholesky(covariance), residual.T)
        _, log_det_covariance = np.linalg.slogdet(2 * np.pi * covariance)
        return -0.5 * (np.sum(white**2, axis=0) + log_det_covariance) + log_det

    def sample(
        self, x0: ArrayLike, n_steps: int, dt: float, *, rng: np.random.Generator
    ) -> FloatArray:
        """Draw trajectories of the stochastic system from x0 (..., d).

        The transitions are exact for any dt > 0 (seconds), n_steps is a whole number >= 0. Returns
        shape (..., n_steps + 1, d).
        """
        states, shape = self._states(x0)
        n_steps, dt = whole_number(n_steps), seconds(dt)
        z, _ = self._encode(states)
        forward, covariance = self._latent.transition(dt / self._time)
        root = np.linalg.cholesky(covariance)
        path = np.empty((len(z), n_steps + 1, shape[-1]))
        path[:, 0] = z
        noise = rng.standard_normal((n_steps, *z.shape)) @ root.T
        for k in range(n_steps):
            path[:, k + 1] = path[:, k] @ forward.T + noise[k]
        decoded = self._decode(path.reshape(-1, shape[-1])).reshape(path.shape)
        decoded[:, 0] = states
        return decoded.reshape(*shape[:-1], n_steps + 1, shape[-1])

    # Files --------------------------------------------------------------------------------

    def _arrays(self) -> dict[str, NDArray[Any]]:
        return dict(self._parameters)

    def _restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        self._adopt(arrays, self.n_dims_)

    def _adopt(self, arrays: Mapping[str, NDArray[Any]], d: int) -> None:
        """Take the parameters over and check all that Lemma 1 needs of them."""
        names = (*NAMES, "drift", "diffusion", "scales")
        parameters = {k: np.asarray(arrays[k], dtype=np.float64) for k in names}
        rotation, drift, diffusion, scales = (
            parameters[k] for k in ("rotation", "drift", "diffusion", "scales")
        )
        flow = Flow(parameters, self.config.log_scale_bound)
        shapes = [rotation.shape[1:], drift.shape, diffusion.shape, scales.shape]
        if shapes != (expected := [(d, d), (d, d), (d, d), (2,)]):
            raise ValueError(
                f"expected each rotation, drift, diffusion and scales of shapes {expected}, got "
                f"{shapes}"
            )
        if not (scales > 0).all():
            raise ValueError(f"expected scales of length and time > 0, got {scales}")
        turned = np.linalg.norm(np.swapaxes(rotation, 1, 2) @ rotation - np.eye(d), axis=(1, 2))
        if not (off := turned.max()) <= ORTHOGONAL:
            raise ValueError(f"expected orthogonal rotations, got |R^T R - I| = {off:.3g}")
        if not (slowest := np.linalg.eigvalsh(drift + drift.T).max() / 2) < 0:
            raise ValueError(
                "expected a drift whose symmetric part is negative definite, got the eigenvalue "
                f"{slowest:.3g}"
            )
        check_positive_definite(diffusion, "diffusion")
        attractor = flow.inverse(np.zeros((1, d)))[0]
        if not (off := np.abs(flow.forward(attractor)).max()) <= INVERSE:
            raise ValueError(f"expected a flow that inverts at the goal, got an error of {off:.3g}")
        self._parameters, self._flow, self._attractor = parameters, flow, attractor
        self._latent = Latent(drift, diffusion)
        self._length, self._time = (float(s) for s in scales)


def _nearest_orthogonal(rotations: NDArray[Any]) -> FloatArray:
    """Undo float32's rounding: the nearest orthogonal matrices to rotations (layers, d, d)."""
    left, _, right = np.linalg.svd(rotations)
    return np.asarray(left @ right, dtype=np.float64)
