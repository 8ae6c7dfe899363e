"""CLF-DM: a regression of velocities, made stable by a learned control Lyapunov function.

Khansari-Zadeh & Billard, "Learning control Lyapunov function to ensure stability of dynamical
system-based robot reaching motions", Robotics and Autonomous Systems 62(6), 2014. V is learned from
the demonstrations (`energy`), a regressor fhat from the same (`regressors`), and

    f(x) = fhat(x) + u(x),    u = 0 where ∇Vᵀfhat + rho <= 0,
                              u = -(∇Vᵀfhat + rho) / ‖∇V‖² ∇V elsewhere,    u = -fhat at the goal,

so that dV/dt <= -rho(x) < 0. There are two forms of rho, by name (`CLFDMConfig.rho`):

    "paper"   rho0 (1 - exp(-kappa0 ‖x‖))
    "code"    rho0 (1 - exp(-kappa0 ‖x‖²)) ‖∇V‖,   what the authors published

Deviations from the paper:

- Offsets are measured in their root mean square, times in that over the velocities' root mean
  square, and V in its mean over the demonstrations, so that rho0 and kappa0 mean the same for every
  motion and unit; their defaults are therefore not the paper's.
- `step` knows dt. The state after an explicit Euler step of f is pulled back along the ray to the
  goal onto the level V(x) exp(-rho dt / V(x)) wherever it lies above: V falls at every step of any
  dt, and nothing chatters. The authors' code shrinks and turns the command up to ten times, which
  promises nothing.
- V is searched for without constraints (Cholesky factors), from several starts for each L and for
  several w, each P with eigenvalues of a bounded ratio. Of the V for every w and every L that
  gained, and of several mixtures, the pair is kept whose reproductions of the
  fitted demonstrations have the least Fréchet distance to them.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from iflow_gym.baselines.clf_dm.config import CLFDMConfig
from iflow_gym.baselines.clf_dm.energy import Energy, learn_energy
from iflow_gym.baselines.clf_dm.regressors import CLASSES, Regressor, fit_regressors
from iflow_gym.baselines.gmr import scaled_samples
from iflow_gym.baselines.subsets import evenly
from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.metrics import frechet
from iflow_gym.system import DynamicalSystem, Guarantee, check_positive_definite

REPRODUCTION_STEPS = 250
"""About so many steps has a reproduction when regressors and V are chosen among."""

FINALISTS = (4, 3)
FULL = 5
CH = 1

PREFIX = "regressor."
"""Before the names of the regressor's arrays in a file."""


class CLFDM(DynamicalSystem):
    """A regressor whose velocities are corrected where V would not fall.

    Attributes
    ----------
    energy_ : Energy
        V of offsets from the goal over `length_`; 1 on the demonstrations' average.
    regressor_ : Regressor
        Velocities of offsets from the goal, in length and length/s.
    length_, time_ : float
        Root mean square distance from the goal, and that over the root mean square speed.

    References
    ----------
    Khansari-Zadeh & Billard, Robotics and Autonomous Systems 62(6), 2014.

    Examples
    --------
    >>> from iflow_gym import load_lasa
    >>> from iflow_gym.baselines.clf_dm import CLFDM
    >>> system = CLFDM(max_terms=0, n_components=4).fit(load_lasa("Angle"), seed=0)
    >>> bool(system.lyapunov_rate([-30.0, 20.0]) < 0)
    True
    """

    name: ClassVar[str] = "clf-dm"
    title: ClassVar[str] = "CLF-DM"
    Config: ClassVar[type] = CLFDMConfig
    integrator: ClassVar[str] = "explicit Euler, pulled back onto a lower level of V"
    config: CLFDMConfig

    def _fit(self, demonstrations: Demonstrations, rng: np.random.Generator) -> None:
        config, goal = self.config, demonstrations.attractor
        x = np.concatenate(demonstrations.positions) - goal
        v = np.concatenate(demonstrations.velocities)
        regressors = fit_regressors(x, v, config, rng)
        both, scale = scaled_samples(x, v)
        few = evenly(both, config.energy_samples)
        d = x.shape[1]
        energies = [
            energy
            for weight in config.weights
            for i in range(CH)
            for energy in learn_energy(
                few[:, :d], few[:, d:], config.max_terms, config.least_gain, weight, rng
            )[min(i,1):]
        ]
        scales = float(scale[0]), float(scale[0] / scale[-1])

        def error(pair: tuple[Energy, Regressor], every: int) -> float:
            self._adopt(*pair, *scales, goal)
            return self._reproduction_error(demonstrations, every)

        pair = self._best_pair(energies, regressors, demonstrations, error)
        self._adopt(*pair, *scales, goal)

    def _best_pair(self, energies, regressors, demonstrations, error):
        """Return V and the regressor that reproduce the fitted demonstrations best.

        All regressors are tried with one V, all V with the best of them, the best of both with each
        other, and the best pairs at the demonstrations' own sample time.
        """
        longest = max(len(p) for p in demonstrations.positions)
        coarse = max(1, round(longest / REPRODUCTION_STEPS))
        errors = {}

        def tried(pairs):
            for pair in pairs:
                if pair not in errors:
                    errors[pair] = error(pair, coarse)
            return sorted(pairs, key=errors.__getitem__)

        by_regressor = tried([(energies[-1], r) for r in regressors])[:FINALISTS[1]]
        by_energy = tried([(e, by_regressor[0][1]) for e in energies])[:FINALISTS[0]]
        tried([(e, r) for e, _ in by_energy for _, r in by_regressor])
        last = sorted(errors, key=errors.__getitem__)[:FULL]
        return min(last, key=lambda pair: error(pair, 1))

    def _reproduction_error(self, demonstrations: Demonstrations, every: int) -> float:
        """Return the mean Fréchet distance of reproductions to the demonstrations.

        Steps are `every` samples long; distances are taken between about REPRODUCTION_STEPS samples.
        """
        longest = max(len(p) for p in demonstrations.positions)
        dt = np.array(demonstrations.dt) * every
        paths = [demonstrations.starts]
        for _ in range((longest - 1) // every):
            paths.append(self._step(paths[-1], dt))
        made = np.stack(paths, axis=1)
        thin = max(1, round(longest / REPRODUCTION_STEPS / every))
        shown = [p[::every][::thin] for p in demonstrations.positions]
        pairs = [(p, path[::thin][: len(p)]) for p, path in zip(shown, made, strict=True)]
        return float(np.mean([frechet(p, q) for p, q in pairs]))

    def _adopt(
        self,
        energy: Energy,
        regressor: Regressor,
        length: float,
        time: float,
        goal: FloatArray,
    ) -> None:
        self.energy_, self.regressor_ = energy, regressor
        self.length_, self.time_ = length, time
        self._goal = goal

    # The controller -----------------------------------------------------------------------

    def _corrected(self, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return f, V, rho and the gradient of V, in units of length_ and time_, x likewise."""
        raw = self.regressor_.velocity(x * self.length_) * (self.time_ / self.length_)
        value, gradient = self.energy_.value_and_gradient(x)
        square = (gradient * gradient).sum(axis=1)
        distance = (x * x).sum(axis=1)
        kappa = self.config.kappa0
        if self.config.rho == "paper":
            rho = -self.config.rho0 * np.expm1(-kappa * np.sqrt(distance))
        else:
            rho = -self.config.rho0 * np.expm1(-kappa * distance) * np.sqrt(square)
        excess = np.maximum((gradient * raw).sum(axis=1) + rho, 0.0)
        moving = square > 0
        pull = np.where(moving, excess / np.where(moving, square, 1.0), 0.0)
        velocity = np.where(moving[:, None], raw - pull[:, None] * gradient, 0.0)
        return velocity, value, rho, gradient

    def _velocity(self, x: FloatArray) -> FloatArray:
        velocity, _, _, _ = self._corrected((x - self._goal) / self.length_)
        return velocity * (self.length_ / self.time_)

    def _step(self, x: FloatArray, dt: FloatArray) -> FloatArray:
        offset = (x - self._goal) / self.length_
        steps = dt / self.time_
        velocity, value, rho, _ = self._corrected(offset)
        after = offset + steps[:, None] * velocity
        safe = np.where(value > 0, value, 1.0)
        level = value * np.exp(-rho * steps / safe)
        above = np.flatnonzero(self.energy_.value(after) > level)
        if len(above):
            after[above] = self.energy_.pulled_back(after[above], level[above])
        return np.asarray(self._goal + self.length_ * after)

    def _lyapunov(self, x: FloatArray) -> FloatArray:
        return self.energy_.value((x - self._goal) / self.length_)

    def _lyapunov_rate(self, x: FloatArray) -> FloatArray:
        velocity, _, _, gradient = self._corrected((x - self._goal) / self.length_)
        return np.asarray((gradient * velocity).sum(axis=1) / self.time_)

    @property
    def guarantee(self) -> Guarantee:
        """Global asymptotic stability: V falls by at least rho along the corrected field."""
        self._require_fit()
        least = float(np.linalg.eigvalsh(self.energy_.matrices).min())
        return Guarantee(
            "proved",
            f"V has {len(self.energy_.centres)} asymmetric terms and positive definite matrices "
            f"(least eigenvalue {least:.3g}), so that the goal is its only minimum; the correction "
            f"makes dV/dt <= -rho < 0 (rho of the {self.config.rho}), and every step of any dt "
            "ends on a lower level",
        )

    # Files --------------------------------------------------------------------------------

    def _arrays(self) -> dict[str, np.ndarray[Any, Any]]:
        of_regressor = {PREFIX + k: a for k, a in self.regressor_.arrays().items()}
        return {
            "matrices": self.energy_.matrices,
            "centres": self.energy_.centres,
            "scales": np.array([self.length_, self.time_]),
            **of_regressor,
        }

    def _restore(self, arrays: Mapping[str, np.ndarray[Any, Any]]) -> None:
        d = self.n_dims_
        matrices, centres, scales = (
            np.asarray(arrays[k], dtype=np.float64) for k in ("matrices", "centres", "scales")
        )
        n = len(matrices) if matrices.ndim else 0
        expected = [(n, d, d), (n - 1, d), (2,)]
        if n < 1 or [matrices.shape, centres.shape, scales.shape] != expected:
            raise ValueError(
                f"expected matrices, centres and scales of shapes {expected} with n >= 1, got "
                f"{[matrices.shape, centres.shape, scales.shape]}"
            )
        check_positive_definite(matrices, "matrix of V")
        if not (scales > 0).all():
            raise ValueError(f"expected scales of length and time > 0, got {scales}")
        own = {k.removeprefix(PREFIX): a for k, a in arrays.items() if k.startswith(PREFIX)}
        regressor = CLASSES[self.config.regressor].of_arrays(own, d)
        self._adopt(
            Energy(matrices, centres), regressor, float(scales[0]), float(scales[1]), self.goal_
        )
