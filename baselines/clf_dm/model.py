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
  gained, and of several mixtures, the pair is kept whose reproductions of the fitted demonstrations
  have the least Fréchet distance to them (`selection`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from iflow_gym.baselines.clf_dm.config import CLFDMConfig
from iflow_gym.baselines.clf_dm.controller import Controller
from iflow_gym.baselines.clf_dm.energy import Energy, learn_energies
from iflow_gym.baselines.clf_dm.regressors import CLASSES, Regressor, fit_regressors
from iflow_gym.baselines.clf_dm.selection import best_controller
from iflow_gym.baselines.gmr import scaled_samples
from iflow_gym.baselines.subsets import evenly
from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.system import DynamicalSystem, Guarantee, check_positive_definite

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
        phases = np.concatenate([np.linspace(0, 1, len(p)) for p in demonstrations.positions])
        regressors = fit_regressors(x, v, phases, config, rng)
        both, scale = scaled_samples(x, v)
        few = evenly(both, config.energy_samples)
        d = x.shape[1]
        energies = learn_energies(
            few[:, :d],
            few[:, d:],
            config.weights,
            config.n_searches,
            config.max_terms,
            config.least_gain,
            rng,
        )
        length, time = float(scale[0]), float(scale[0] / scale[-1])

        def controller(energy: Energy, regressor: Regressor) -> Controller:
            return self._controller(energy, regressor, length, time)

        positions = [(p - goal) / length for p in demonstrations.positions]
        times = np.array(demonstrations.dt) / time
        self._adopt(best_controller(energies, regressors, controller, positions, times), goal)

    def _controller(
        self, energy: Energy, regressor: Regressor, length: float, time: float
    ) -> Controller:
        config = self.config
        return Controller(energy, regressor, length, time, config.rho, config.rho0, config.kappa0)

    def _adopt(self, controller: Controller, goal: FloatArray) -> None:
        self.controller_, self._goal = controller, goal
        self.energy_, self.regressor_ = controller.energy, controller.regressor
        self.length_, self.time_ = controller.length, controller.time

    def _offsets(self, x: FloatArray) -> FloatArray:
        return (np.asfortranarray(x) - self._goal) / self.length_

    def _velocity(self, x: FloatArray) -> FloatArray:
        velocity, _, _, _ = self.controller_.corrected(self._offsets(x))
        return velocity * (self.length_ / self.time_)

    def _step(self, x: FloatArray, dt: FloatArray) -> FloatArray:
        after = self.controller_.step(self._offsets(x), dt / self.time_)
        return np.asarray(self._goal + self.length_ * after)

    def _lyapunov(self, x: FloatArray) -> FloatArray:
        return self.energy_.value(self._offsets(x))

    def _lyapunov_rate(self, x: FloatArray) -> FloatArray:
        velocity, _, _, gradient = self.controller_.corrected(self._offsets(x))
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
        length, time = scales.tolist()
        self._adopt(
            self._controller(Energy(matrices, centres), regressor, length, time), self.goal_
        )
