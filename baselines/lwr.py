"""Locally weighted regression of the velocity on the position.

For each position asked for, a weighted least-squares fit of an affine map to the samples around it,
whose value there is the velocity (Atkeson, Moore & Schaal, "Locally weighted learning", Artificial
Intelligence Review 11, 1997, eq. (9)-(15); Cleveland & Devlin, JASA 83, 1988):

    f(x) = b,   (b, A) = argmin sum_i w_i ‖b + A (x_i - x) - v_i‖² + ridge (sum_i w_i) h² ‖A‖²,
    w_i = exp(-‖x_i - x‖² / 2 h²).

The ridge term (ibid., section 9.1) matters where the samples around x lie on a line or are far. The
bandwidth h is the one of least error on demonstrations left out one at a time (ibid., section 8.2,
with demonstrations in place of samples: neighbours in time are no test of each other).

Deviation: samples are thinned to an even subset, so that a batch of positions takes less than a
millisecond.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from iflow_gym.baselines.elementwise import exp2_
from iflow_gym.baselines.kernels import SquaredExponentials
from iflow_gym.baselines.subsets import evenly
from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.system import DynamicalSystem, Guarantee

BANDWIDTHS = np.geomspace(0.005, 0.3, 12)
"""Candidates for the bandwidth, in diagonals of the demonstrations' bounding box."""

BLOCKS = 10
"""A single demonstration is cut into so many pieces in time, which are left out one at a time."""

SELECTION_SAMPLES = 1000
"""Samples, evenly taken, on which bandwidths are compared."""

SMALL = -900.0
"""Where all weights are below 2 to this power, they are taken relative to the nearest sample's."""


@dataclass(frozen=True)
class LWRConfig:
    """Settings of `LWR`."""

    bandwidth: float | None = None
    """h, in diagonals of the demonstrations' bounding box; None leaves demonstrations out to
    choose it."""
    ridge: float = 1.0
    """Weight of the slopes' penalty: 1 is as much as samples at one bandwidth's distance weigh."""
    n_samples: int = 700
    """Samples, evenly taken, that are kept."""

    def __post_init__(self) -> None:
        if self.bandwidth is not None and not self.bandwidth > 0:
            raise ValueError(f"Expected bandwidth > 0 or None, got {self.bandwidth}.")
        if not self.ridge > 0:
            raise ValueError(
                f"Expected ridge > 0, got {self.ridge}: far from the samples the fit would be "
                "singular."
            )
        if self.n_samples < 2:
            raise ValueError(f"Expected n_samples >= 2, got {self.n_samples}.")


class LWR(DynamicalSystem):
    """Locally weighted regression: an affine fit around each position.

    Far from the samples, where all weights underflow, they are taken relative to the nearest
    sample's; the ridge then keeps the slopes small, and the velocity is about the nearest sample's.

    Attributes
    ----------
    positions_, velocities_ : arrays, shape (n, d)
        The samples that are kept, as offsets from the centre, in length and length/s.
    bandwidth_ : float
        h, in length.

    References
    ----------
    Atkeson, Moore & Schaal, Artificial Intelligence Review 11, 1997.

    Examples
    --------
    >>> from iflow_gym import load_lasa
    >>> system = LWR(bandwidth=0.03).fit(load_lasa("Angle"), seed=0)
    >>> system.guarantee.kind
    'none'
    """

    name: ClassVar[str] = "lwr"
    title: ClassVar[str] = "LWR"
    Config: ClassVar[type] = LWRConfig
    stochastic_fit: ClassVar[bool] = False
    learns_cycles: ClassVar[bool] = True

    def _fit(self, demonstrations: Demonstrations, rng: np.random.Generator) -> None:
        centre = demonstrations.centre
        x = [p - centre for p in demonstrations.positions]
        v = list(demonstrations.velocities)
        fraction = self.config.bandwidth
        if fraction is None:
            fraction = choose_bandwidth(
                x, v, demonstrations.bounding_box.diagonal, self.config.ridge
            )
        kept = self.config.n_samples
        self._adopt(
            evenly(np.concatenate(x), kept),
            evenly(np.concatenate(v), kept),
            float(fraction) * demonstrations.bounding_box.diagonal,
            centre,
        )

    def _adopt(
        self, positions: FloatArray, velocities: FloatArray, bandwidth: float, centre: FloatArray
    ) -> None:
        self.positions_, self.velocities_, self.bandwidth_ = positions, velocities, bandwidth
        self._centre = centre
        self._local = LocalFits(positions / bandwidth, velocities, self.config.ridge)

    def _velocity(self, x: FloatArray) -> FloatArray:
        return self._local((x - self._centre) / self.bandwidth_)

    @property
    def guarantee(self) -> Guarantee:
        """None: the regression knows nothing of the goal."""
        return Guarantee(
            "none",
            "a regression of velocities: nothing in it keeps the goal an equilibrium or attracts "
            "to it, and away from the demonstrations it goes on as the nearest samples do",
        )

    def _arrays(self) -> dict[str, np.ndarray[Any, Any]]:
        return {
            "positions": self.positions_,
            "velocities": self.velocities_,
            "bandwidth": np.array([self.bandwidth_]),
        }

    def _restore(self, arrays: Mapping[str, np.ndarray[Any, Any]]) -> None:
        names = ("positions", "velocities", "bandwidth")
        x, v, bandwidth = (np.asarray(arrays[k], dtype=np.float64) for k in names)
        n = len(np.atleast_1d(x))
        expected, came = [(n, self.n_dims_)] * 2 + [(1,)], [a.shape for a in (x, v, bandwidth)]
        if n < 1 or came != expected:
            raise ValueError(
                f"expected {', '.join(names)} of shapes {expected} with n >= 1, got {came}"
            )
        if not bandwidth > 0:
            raise ValueError(f"expected a bandwidth > 0, got {bandwidth}")
        self._adopt(x, v, float(bandwidth[0]), self.goal_)


class LocalFits:
    """Affine fits around positions, with the bandwidth as the unit of length.

    Parameters
    ----------
    x : array, shape (n, d)
        Positions of the samples, in bandwidths.
    v : array, shape (n, k)
        What is regressed.
    ridge : float
    """

    def __init__(self, x: FloatArray, v: FloatArray, ridge: float) -> None:
        n, d = x.shape
        self._n_outputs, self._ridge = v.shape[1], ridge * np.eye(d)[:, :, None]
        self._kernels = SquaredExponentials(x, 1.0)
        rows, columns = np.triu_indices(d)
        crossed = (x[:, :, None] * v[:, None]).reshape(n, -1)
        self._moments = np.hstack([np.ones((n, 1)), x, v, crossed, x[:, rows] * x[:, columns]])
        self._squares = np.empty((d, d), dtype=int)  # where x xᵀ is among the moments
        self._squares[rows, columns] = self._squares[columns, rows] = np.arange(-len(rows), 0)

    def __call__(self, x: FloatArray) -> FloatArray:
        """Return the fits' values, shape (n, k), at positions x, shape (n, d), in bandwidths."""
        (n, d), k = x.shape, self._n_outputs
        weights = self._kernels.exponents(x)
        greatest = weights.max(axis=1)
        # Above 1 where, unlikely far away, the digits of a distance are lost.
        if not (greatest.min(initial=0.0) > SMALL and greatest.max(initial=0.0) < 1):
            weights = self._kernels.relative_exponents(x)
        sums = (exp2_(weights) @ self._moments).T
        sums = sums / sums[0]
        mean_x, mean_v = sums[1 : 1 + d], sums[1 + d : 1 + d + k]
        crossed = sums[1 + d + k : 1 + d + k + d * k].reshape(d, k, n)
        # b = mean_v - A (mean_x - x): the intercept of a fit whose slopes alone are penalised.
        covariance = sums[self._squares] - mean_x[:, None] * mean_x + self._ridge
        across = crossed - mean_x[:, None] * mean_v
        away = np.linalg.solve(covariance.T, (x - mean_x.T)[:, :, None])[:, :, 0].T
        return np.asarray((mean_v + (away[:, None] * across).sum(axis=0)).T)


def choose_bandwidth(
    x: Sequence[FloatArray], v: Sequence[FloatArray], diagonal: float, ridge: float
) -> float:
    """Return the bandwidth, in diagonals, of least squared error on what was left out.

    Parameters
    ----------
    x, v : sequences of arrays, shape (T_i, d)
        Positions and velocities of each demonstration, in length and length/s.
    diagonal : float
        Of the demonstrations' bounding box, in length.
    ridge : float
    """
    share = max(2, SELECTION_SAMPLES // len(x))
    x = [evenly(p, share) / diagonal for p in x]
    v = [evenly(p, share) for p in v]
    if len(x) == 1:
        x, v = ([p for p in np.array_split(a[0], BLOCKS) if len(p)] for a in (x, v))
    errors = np.zeros(len(BANDWIDTHS))
    for out in range(len(x)):
        kept_x = np.concatenate([p for i, p in enumerate(x) if i != out])
        kept_v = np.concatenate([p for i, p in enumerate(v) if i != out])
        for j, h in enumerate(BANDWIDTHS):
            errors[j] += np.sum((LocalFits(kept_x / h, kept_v, ridge)(x[out] / h) - v[out]) ** 2)
    return float(BANDWIDTHS[int(errors.argmin())])
