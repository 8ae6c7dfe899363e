"""The regressors that CLF-DM corrects: velocities of offsets from the goal, and no guarantee.

Each has `velocity`, and `arrays`, from which its class makes it again. A Gaussian process's mean
and support vector regression are the same sum of kernels.

Far from every sample a regression says nothing, and what it extrapolates may point straight up V,
where the correction leaves no more than the least descent. There every regressor goes straight to
the goal, -`HOMING` x, which V falls along: a mixture by one broad Gaussian more, sums of kernels by
being fitted to what is beyond it.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from scipy.spatial.distance import cdist
from sklearn.svm import SVR

from iflow_gym.baselines.clf_dm.config import CLFDMConfig
from iflow_gym.baselines.gmr import (
    SAMPLES_PER_COMPONENT,
    GMRConfig,
    MixtureField,
    check_components,
    checked_mixture,
    choose_components,
    expectation_maximisation,
    in_units,
    scaled_samples,
)
from iflow_gym.baselines.gpr import maximise_likelihood
from iflow_gym.baselines.subsets import evenly
from iflow_gym.demonstrations import FloatArray

SVR_TUBE = 0.02
"""epsilon, with positions and velocities of root mean square 1."""

SVR_COSTS, SVR_LENGTHS = (10.0, 1000.0), (0.25, 0.5, 1.0)
"""C, and the kernel's length in the same units: all pairs are tried."""

GPR_STRETCHES = (1.0, 1.5, 2.5)
"""Lengths of the kernel over the likeliest ones: all are tried."""

HOMING = 1.0
"""Rate at which a state far from the samples nears the goal, in root mean square speeds a root mean
square distance."""

BROAD_PRIOR, BROAD_SPREAD = 1e-2, 2.0
"""Weight of the broad Gaussian, and its standard deviation in root mean square distances."""


KernelSum = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""Points, weights, bias and lengths of a `KernelRegressor`, in units of root mean squares."""


class Regressor(Protocol):
    """A field of velocities, (n, d) -> (n, d), whose numbers fit in a file."""

    def velocity(self, x: FloatArray) -> FloatArray:
        """Return velocities, shape (n, d), at offsets from the goal, shape (n, d)."""

    def arrays(self) -> dict[str, FloatArray]:
        """Return what a file holds."""


class MixtureRegressor:
    """Gaussian mixture regression, as `GMR` does it."""

    def __init__(self, priors: FloatArray, means: FloatArray, covariances: FloatArray) -> None:
        self._mixture = {"priors": priors, "means": means, "covariances": covariances}
        self.field = MixtureField.of_joint(priors, means, covariances)

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, np.ndarray[Any, Any]], d: int) -> MixtureRegressor:
        """Return the regressor of a file's arrays; raise ValueError if they are no mixture."""
        return cls(*checked_mixture(arrays, d))

    def velocity(self, x: FloatArray) -> FloatArray:
        """Return E[v | x]."""
        return self.field.velocity(x)

    def arrays(self) -> dict[str, FloatArray]:
        """Return priors, means and covariances."""
        return dict(self._mixture)


class KernelRegressor:
    """v(x) = bias - rate x + sum_i w_i exp(-‖(x - x_i) / lengths‖² / 2).

    Parameters
    ----------
    points : array, shape (m, d)
    weights : array, shape (m, d)
        In units of velocity.
    bias : array, shape (d,)
    lengths : array, shape (d,)
        Of the kernel, along each axis.
    rate : array, shape (1,)
    """

    def __init__(
        self,
        points: FloatArray,
        weights: FloatArray,
        bias: FloatArray,
        lengths: FloatArray,
        rate: FloatArray,
    ) -> None:
        weights = np.ascontiguousarray(weights)  # the layout decides how a product rounds
        self._numbers = {
            "points": points,
            "weights": weights,
            "bias": bias,
            "lengths": lengths,
            "rate": rate,
        }
        # -‖x - x_i‖² / 2 = x · x_i - ‖x_i‖² / 2 - ‖x‖² / 2, with x over `lengths`.
        self._points = (points / lengths).T.copy()
        self._halves = 0.5 * (self._points**2).sum(axis=0)
        self._weights, self._bias = weights, bias
        self._lengths, self._rate = lengths, float(rate[0])

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, np.ndarray[Any, Any]], d: int) -> KernelRegressor:
        """Return the regressor of a file's arrays; raise ValueError if they do not fit."""
        names = ("points", "weights", "bias", "lengths", "rate")
        values = [np.asarray(arrays[name], dtype=np.float64) for name in names]
        m = len(values[0]) if values[0].ndim else 0
        expected, came = [(m, d), (m, d), (d,), (d,), (1,)], [a.shape for a in values]
        if m < 1 or came != expected:
            raise ValueError(
                f"expected {', '.join(names)} of shapes {expected} with m >= 1, got {came}"
            )
        if not (values[3] > 0).all():
            raise ValueError(f"expected a kernel's lengths > 0, got {values[3]}")
        return cls(*values)

    def velocity(self, x: FloatArray) -> FloatArray:
        """Return v(x)."""
        near = x / self._lengths
        kernel = near @ self._points
        kernel -= self._halves
        kernel -= 0.5 * (near * near).sum(axis=1, keepdims=True)
        np.exp(kernel, out=kernel)
        return np.asarray(kernel @ self._weights + (self._bias - self._rate * x))

    def arrays(self) -> dict[str, FloatArray]:
        """Return points, weights, bias, lengths and rate."""
        return dict(self._numbers)


CLASSES: dict[str, type[MixtureRegressor] | type[KernelRegressor]] = {
    "gmr": MixtureRegressor,
    "gpr": KernelRegressor,
    "svr": KernelRegressor,
}
"""Name in the settings to the class that makes it of a file's arrays."""

MIXTURE_SAMPLES = 2000
"""Samples, evenly taken, that a mixture is fitted on."""

MORE_COMPONENTS = (-4, -2, 0, 2, 4, 6, 8)
"""Added to the number of Gaussians that BIC chooses."""


def fit_regressors(
    x: FloatArray,
    v: FloatArray,
    phases: FloatArray,
    config: CLFDMConfig,
    rng: np.random.Generator,
) -> list[Regressor]:
    """Fit the regressors that the settings ask for to offsets and velocities, shape (n, d) each.

    Of a mixture there are several: BIC and the likelihood choose among densities of samples, and
    say little about which field leads along the demonstrations. `phases`, shape (n,), are the
    samples' times from 0 at their demonstration's start to 1 at its end.
    """
    if config.regressor == "gmr":
        return _mixtures(x, v, phases, config, rng)
    both, scale = scaled_samples(x, v)
    few = evenly(both, config.kernel_samples)
    d = x.shape[1]
    beyond = few[:, d:] + HOMING * few[:, :d]
    rate = np.array([HOMING * scale[-1] / scale[0]])
    found = (
        _gaussian_processes(few[:, :d], beyond)
        if config.regressor == "gpr"
        else [
            _support_vectors(few[:, :d], beyond, cost, length)
            for cost, length in itertools.product(SVR_COSTS, SVR_LENGTHS)
        ]
    )
    return [
        KernelRegressor(
            points * scale[0],
            weights * scale[-1],
            bias * scale[-1],
            lengths * scale[0],
            rate,
        )
        for points, weights, bias, lengths in found
    ]


def _mixtures(
    x: FloatArray,
    v: FloatArray,
    phases: FloatArray,
    config: CLFDMConfig,
    rng: np.random.Generator,
) -> list[Regressor]:
    """Fit mixtures of several numbers of Gaussians, each from several starts.

    The first start of EM cuts every demonstration into as many pieces of equal time; the others
    are by k-means.
    """
    settings = GMRConfig()
    both, scale = scaled_samples(x, v)
    if config.n_components is not None:
        numbers = [config.n_components]
    else:
        least = choose_components(both, settings, int(rng.integers(2**31)))
        most = max(least, len(both) // SAMPLES_PER_COMPONENT)
        numbers = [n for more in MORE_COMPONENTS if 1 <= (n := least + more) <= most]
    found: list[Regressor] = []
    for n in numbers:
        check_components(n, len(both))
        few = evenly(np.column_stack([both, phases]), max(MIXTURE_SAMPLES, n))
        pieces = np.minimum((few[:, -1] * n).astype(int), n - 1)
        usable = np.bincount(pieces, minlength=n).min() > 0
        for i in range(config.n_initialisations):
            mixture = expectation_maximisation(
                few[:, :-1],
                n,
                1,
                settings.regularisation,
                int(rng.integers(2**31)),
                pieces if usable and i == 0 else None,
            )
            found.append(MixtureRegressor(*_homing(*in_units(mixture, scale), x, v)))
    return found


def _homing(
    priors: FloatArray, means: FloatArray, covariances: FloatArray, x: FloatArray, v: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the mixture with a broad Gaussian about the goal, whose own field is -HOMING x."""
    d = x.shape[1]
    length, speed = np.sqrt(np.mean(x**2)), np.sqrt(np.mean(v**2))
    rate = HOMING * speed / length
    spread = (BROAD_SPREAD * length) ** 2
    block = np.array([[spread, -rate * spread], [-rate * spread, rate**2 * spread + speed**2]])
    return (
        np.append((1 - BROAD_PRIOR) * priors, BROAD_PRIOR),
        np.concatenate([means, np.zeros((1, 2 * d))]),
        np.concatenate([covariances, np.kron(block, np.eye(d))[None]]),
    )


def _gaussian_processes(x: FloatArray, v: FloatArray) -> list[KernelSum]:
    """Fit one process to all coordinates, its hyperparameters by the likelihood, as `GPR` does.

    Again with longer kernels, which the likelihood may not want and a motion may.
    """
    signal, lengths, noise = maximise_likelihood(x, v)
    found: list[KernelSum] = []
    for stretch in GPR_STRETCHES:
        scaled = x / (stretch * lengths)
        gram = signal * np.exp(-0.5 * cdist(scaled, scaled, "sqeuclidean"))
        weights = signal * np.asarray(np.linalg.solve(gram + noise * np.eye(len(x)), v))
        found.append((x, weights, np.zeros(v.shape[1]), stretch * lengths))
    return found


def _support_vectors(x: FloatArray, v: FloatArray, cost: float, length: float) -> KernelSum:
    """Fit one machine for each coordinate."""
    weights, bias = np.zeros_like(v), np.zeros(v.shape[1])
    for i in range(v.shape[1]):
        machine = SVR(C=cost, epsilon=SVR_TUBE, gamma=0.5 / length**2).fit(x, v[:, i])
        weights[machine.support_, i] = machine.dual_coef_[0]
        bias[i] = float(machine.intercept_[0])
    used = (weights != 0).any(axis=1)
    used[0] |= not used.any()
    return x[used], weights[used], bias, np.full(x.shape[1], length)
