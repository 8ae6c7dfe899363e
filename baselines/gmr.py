"""Gaussian mixture regression: accurate near the demonstrations, and bound by nothing.

Positions and velocities are modelled jointly, p(x, v) = sum_k pi_k N((x, v); mu_k, Sigma_k), by EM,
and the field is the conditional mean

    f(x) = E[v | x] = sum_k h_k(x) (A_k x + b_k),
    A_k = Sigma_vx Sigma_xx^-1,   b_k = mu_v - A_k mu_x,   h_k(x) ~ pi_k N(x; mu_x, Sigma_xx)

(Cohn, Ghahramani & Jordan, "Active learning with statistical models", JAIR 4, 1996, section 5; in
the notation of Khansari-Zadeh & Billard, "Learning stable non-linear dynamical systems with
Gaussian mixture models", IEEE T-RO 27(5), 2011, eq. (8)). SEDS constrains these numbers and CLF-DM
corrects this field; both use the functions of this file.

Deviation: the number of Gaussians is the one of least BIC on every n-th sample, so that choosing
takes less than a second. Samples of a smooth recording are far from independent, so no count of
them is the right one for BIC anyway.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.exceptions import ConvergenceWarning
from sklearn.mixture import GaussianMixture

from iflow_gym.baselines.elementwise import exp_
from iflow_gym.baselines.subsets import evenly
from iflow_gym.demonstrations import Demonstrations, FloatArray
from iflow_gym.system import DynamicalSystem, Guarantee, check_positive_definite

MOST_COMPONENTS = 10
LEAST_COMPONENTS = 2

SAMPLES_PER_COMPONENT = 8
"""A Gaussian is tried for at least so many samples: 30 samples are no ground for 10 Gaussians."""

FAR = 1e8
"""Farther than this from the goal, in the farthest component's distance, the weights are those of
the same direction at this distance, where they have long settled; their squares would overflow."""

PRIORS_TOLERANCE = 1e-6
"""How far from 1 a file's priors may sum."""


@dataclass(frozen=True)
class GMRConfig:
    """Settings of `GMR`."""

    n_components: int | None = None
    """Gaussians in the mixture; None chooses by BIC between 2 and 10."""
    n_initialisations: int = 5
    """Starts of EM, by k-means; the likeliest is kept."""
    selection_samples: int = 1000
    """Samples, evenly taken, on which BIC compares the numbers of Gaussians."""
    fit_samples: int = 3500
    """Samples, evenly taken, on which the chosen mixture is fitted."""
    regularisation: float = 1e-6
    """Added to the variances, with positions and velocities scaled to a mean square of 1."""

    def __post_init__(self) -> None:
        if self.n_components is not None and self.n_components < 1:
            raise ValueError(f"Expected n_components >= 1 or None, got {self.n_components}.")
        for field in ("n_initialisations", "selection_samples", "fit_samples"):
            if getattr(self, field) < 1:
                raise ValueError(f"Expected {field} >= 1, got {getattr(self, field)}.")
        if not self.regularisation > 0:
            raise ValueError(
                f"Expected regularisation > 0, got {self.regularisation}: on a straight line the "
                "covariances would be singular."
            )


class MixtureField:
    """The conditional p(v | x) of a Gaussian mixture over (x, v), ready for many calls.

    Parameters
    ----------
    priors : array, shape (K,)
    centres : array, shape (K, d)
        mu_x: means of the positions.
    spreads : array, shape (K, d, d)
        Sigma_xx, positive definite.
    conditionals : tuple of arrays, shapes (K, d, d), (K, d) and (K, d, d)
        A_k, b_k and Cov(v | x, k), as `conditional` gives them for a joint mixture.

    Attributes
    ----------
    gains : array, shape (K, d, d)
        A_k, in 1/s.
    offsets : array, shape (K, d)
        b_k.
    conditional_covariances : array, shape (K, d, d)
        Cov(v | x, k) = Sigma_vv - A_k Sigma_xv.
    """

    def __init__(
        self,
        priors: FloatArray,
        centres: FloatArray,
        spreads: FloatArray,
        conditionals: tuple[FloatArray, FloatArray, FloatArray],
    ) -> None:
        k, d = centres.shape
        self.n_dims = d
        self.gains, self.offsets, self.conditional_covariances = conditionals
        # log pi_k N(x; mu_k, Sigma_k) = constant_k - ‖W_k x - w_k‖², all k in one product. Arrays
        # have the axis of positions last, so that sums over the short ones are sums of rows.
        whitening = np.linalg.inv(np.linalg.cholesky(spreads))
        self._constants = (
            np.log(priors)
            + np.log(np.diagonal(whitening, axis1=1, axis2=2)).sum(axis=1)
            - 0.5 * d * np.log(2 * np.pi)
        )[:, None]
        rows = np.swapaxes(whitening, 0, 1) / np.sqrt(2)
        self._whitening = rows.reshape(d * k, d)
        self._white_means = np.einsum("ikj,kj->ik", rows, centres).reshape(d * k, 1)
        spread = np.sqrt(np.trace(spreads, axis1=1, axis2=2))
        self._far = FAR * float((np.linalg.norm(centres, axis=1) + spread).max())
        self._stacked_gains = self.gains.reshape(-1, d).T.copy()
        self._flat_gains = self.gains.reshape(k, d * d).T.copy()
        self._flat_offsets = self.offsets.T.copy()

    @classmethod
    def of_joint(cls, priors: FloatArray, means: FloatArray, covariances: FloatArray) -> Self:
        """Return the field of a joint mixture: means (K, 2 d), covariances (K, 2 d, 2 d)."""
        d = means.shape[1] // 2
        return cls(priors, means[:, :d], covariances[:, :d, :d], conditional(means, covariances))

    def log_densities(self, x: FloatArray) -> FloatArray:
        """Return log pi_k N(x; mu_k, Sigma_k), shape (n, K), of positions x, shape (n, d)."""
        return self._log_densities(x).T

    def _log_densities(self, x: FloatArray) -> FloatArray:
        white = self._whitening @ x.T
        white -= self._white_means
        white *= white
        squares = white.reshape(self.n_dims, len(self._constants), len(x)).sum(axis=0)
        return np.asarray(self._constants - squares)

    def weights(self, x: FloatArray) -> FloatArray:
        """Return h_k(x), shape (n, K), rows that sum to 1 wherever x is.

        The largest log density is taken off before the exponential, so that where every density
        underflows the nearest Gaussian, in its own metric, has the weight. Beyond `FAR` positions
        are pulled back along their ray from the goal, whose limit the weights have reached.
        """
        return self._weights(x).T

    def _weights(self, x: FloatArray) -> FloatArray:
        reach = float(np.abs(x).max(initial=0.0))
        if reach > self._far:
            x = x * np.minimum(1.0, self._far / np.abs(x).max(axis=1, keepdims=True))
        h = self._log_densities(x)
        h -= h.max(axis=0)
        exp_(h)
        h /= h.sum(axis=0)
        return h

    def means(self, x: FloatArray) -> FloatArray:
        """Return E[v | x, k] = A_k x + b_k, shape (n, K, d)."""
        return (x @ self._stacked_gains).reshape(len(x), *self.offsets.shape) + self.offsets

    def velocity(self, x: FloatArray) -> FloatArray:
        """Return E[v | x], shape (n, d)."""
        h, d = self._weights(x), self.n_dims
        gain = (self._flat_gains @ h).reshape(d, d, len(x))
        return np.asarray(((gain * x.T).sum(axis=1) + self._flat_offsets @ h).T)

    def gain(self, x: FloatArray) -> FloatArray:
        """Return sum_k h_k(x) A_k, shape (n, d, d)."""
        gain = self._flat_gains @ self._weights(x)
        return gain.T.reshape(len(x), self.n_dims, self.n_dims)

    def covariance(self, x: FloatArray) -> FloatArray:
        """Return Cov(v | x), shape (n, d, d): within the Gaussians and between them."""
        h, means = self.weights(x), self.means(x)
        apart = means - np.einsum("nk,nki->ni", h, means)[:, None]
        return np.asarray(
            np.einsum("nk,kij->nij", h, self.conditional_covariances)
            + np.einsum("nk,nki,nkj->nij", h, apart, apart)
        )

    def log_prob(self, x: FloatArray, v: FloatArray) -> FloatArray:
        """Return log p(v | x), shape (n,): a mixture with the weights h_k(x)."""
        roots = np.linalg.cholesky(self.conditional_covariances)
        constants = np.log(np.diagonal(roots, axis1=1, axis2=2)).sum(axis=1)
        constants += 0.5 * self.n_dims * np.log(2 * np.pi)
        residual = np.moveaxis(v[:, None] - self.means(x), 0, -1)  # (K, d, n)
        squares = (np.linalg.solve(roots, residual) ** 2).sum(axis=1).T
        with np.errstate(divide="ignore"):  # a weight that underflows counts for nothing
            logs = np.log(self.weights(x)) - constants - 0.5 * squares
        top = logs.max(axis=1, keepdims=True)
        return np.asarray(top[:, 0] + np.log(np.exp(logs - top).sum(axis=1)))

    def transition_log_prob(self, x: FloatArray, x_next: FloatArray, dt: float) -> FloatArray:
        """Return log p(x_next | x), shape (n,), of the explicit Euler step with v ~ p(v | x)."""
        return np.asarray(self.log_prob(x, (x_next - x) / dt) - self.n_dims * np.log(dt))


def conditional(
    means: FloatArray, covariances: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return A_k, b_k and Cov(v | x, k) of Gaussians over (x, v).

    Parameters
    ----------
    means : array, shape (K, 2 d)
    covariances : array, shape (K, 2 d, 2 d)

    Returns
    -------
    gains : array, shape (K, d, d)
    offsets : array, shape (K, d)
    conditional_covariances : array, shape (K, d, d)
    """
    d = means.shape[1] // 2
    of_x, across, of_v = covariances[:, :d, :d], covariances[:, :d, d:], covariances[:, d:, d:]
    gains = np.swapaxes(np.linalg.solve(of_x, across), 1, 2)
    offsets = means[:, d:] - np.einsum("kij,kj->ki", gains, means[:, :d])
    remaining = of_v - gains @ across
    return gains, offsets, (remaining + np.swapaxes(remaining, 1, 2)) / 2


def fit_mixture(
    x: FloatArray, v: FloatArray, config: GMRConfig, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Fit a mixture over (x, v) by EM and return priors, means and covariances in their units.

    Parameters
    ----------
    x, v : arrays, shape (n, d)
        Offsets from the goal and velocities.
    config : GMRConfig
    rng : numpy Generator
        Seeds the initialisations.

    Notes
    -----
    Positions are divided by their root mean square and velocities by theirs, one number each, so
    that neither the unit nor a rotation changes the fit; the mixture is scaled back exactly.
    """
    samples, scale = scaled_samples(x, v)
    seed = int(rng.integers(2**31))
    n_components = config.n_components
    if n_components is None:
        n_components = choose_components(samples, config, seed)
    check_components(n_components, len(samples))
    chosen = evenly(samples, max(config.fit_samples, n_components))
    mixture = expectation_maximisation(
        chosen, n_components, config.n_initialisations, config.regularisation, seed
    )
    return in_units(mixture, scale)


def check_components(n_components: int, n_samples: int) -> None:
    """Raise ValueError if there are more Gaussians than samples."""
    if n_components > n_samples:
        raise ValueError(
            f"Expected at most as many Gaussians as samples, {n_samples}, got {n_components}."
        )


def in_units(
    mixture: GaussianMixture, scale: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return priors, means and covariances of a mixture of `scaled_samples`, scaled back."""
    return mixture.weights_, mixture.means_ * scale, mixture.covariances_ * np.outer(scale, scale)


def checked_mixture(
    arrays: Mapping[str, np.ndarray[Any, Any]], d: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return priors, means and covariances from a file; raise ValueError if they are no mixture."""
    names = ("priors", "means", "covariances")
    priors, means, covariances = (np.asarray(arrays[k], dtype=np.float64) for k in names)
    n, size = priors.size, 2 * d
    expected = [(n,), (n, size), (n, size, size)]
    came = [a.shape for a in (priors, means, covariances)]
    if n < 1 or came != expected:
        raise ValueError(
            f"expected {', '.join(names)} of shapes {expected} with n >= 1, got {came}"
        )
    check_priors(priors)
    check_positive_definite(covariances, "covariance")
    return priors, means, covariances


def check_priors(priors: FloatArray) -> None:
    """Raise ValueError unless priors are positive and sum to 1."""
    if not ((priors > 0).all() and abs(priors.sum() - 1) <= PRIORS_TOLERANCE):
        raise ValueError(f"expected priors > 0 that sum to 1, got {priors}")


def scaled_samples(x: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return samples (x, v) over their scale, and that scale, shapes (n, 2 d) and (2 d,).

    The scale is the root mean square of all positions, and that of all velocities.

    Raises
    ------
    ValueError
        If all positions or all velocities are zero.
    """
    scale = np.repeat(np.sqrt([np.mean(x**2), np.mean(v**2)]), x.shape[1])
    if not (scale > 0).all():
        raise ValueError(
            "Expected demonstrations that move, got positions or velocities that are all zero: "
            "leave velocities out to have them estimated from the positions."
        )
    return np.concatenate([x, v], axis=1) / scale, scale


def choose_components(samples: FloatArray, config: GMRConfig, seed: int) -> int:
    """Return the number of Gaussians of least BIC, from 2 to 10, or as many as samples allow."""
    few = evenly(samples, config.selection_samples)
    candidates = numbers_of_components(len(few))
    scores = [
        float(expectation_maximisation(few, k, 1, config.regularisation, seed).bic(few))
        for k in candidates
    ]
    return candidates[int(np.argmin(scores))]


def numbers_of_components(n_samples: int) -> range:
    """Return the numbers of Gaussians that so many samples are ground for."""
    most = min(MOST_COMPONENTS, max(1, n_samples // SAMPLES_PER_COMPONENT))
    return range(min(LEAST_COMPONENTS, most), most + 1)


def expectation_maximisation(
    samples: FloatArray,
    n_components: int,
    n_init: int,
    regularisation: float,
    seed: int,
    labels: NDArray[np.int_] | None = None,
) -> GaussianMixture:
    """Return the likeliest mixture of EM from `n_init` starts by k-means.

    With labels, one a sample from 0 to `n_components` - 1 and none of them unused, EM starts from
    the Gaussians of the samples that share one.
    """
    mixture = GaussianMixture(
        n_components,
        n_init=n_init,
        reg_covar=regularisation,
        random_state=seed,
        max_iter=200,
    )
    if labels is not None:
        d = samples.shape[1]
        groups = [samples[labels == k] for k in range(n_components)]
        around = [g - g.mean(axis=0) for g in groups]
        spreads = [a.T @ a / len(a) + regularisation * np.eye(d) for a in around]
        mixture.set_params(
            n_init=1,
            weights_init=np.array([len(g) for g in groups]) / len(samples),
            means_init=np.array([g.mean(axis=0) for g in groups]),
            precisions_init=np.linalg.inv(spreads),
        )
    with warnings.catch_warnings():
        # EM that still gains a little, and recordings with fewer distinct samples than Gaussians,
        # still give a mixture: the scores tell how good a field it is.
        warnings.simplefilter("ignore", ConvergenceWarning)
        return mixture.fit(samples)


class GMR(DynamicalSystem):
    """Gaussian mixture regression of the velocity on the position.

    `log_prob` is the model's own implication for one explicit Euler step over dt, however long:
    (x_next - x) / dt has the conditional p(v | x), a mixture of the Gaussians
    N(A_k x + b_k, Cov(v | x, k)), whose mean is the field.

    Far from the demonstrations, where every density underflows, the weight is with the Gaussian
    that is nearest in its own metric, and the field is that one's affine map: finite everywhere,
    growing at most linearly, and not necessarily towards the goal.

    Attributes
    ----------
    priors_ : array, shape (K,)
    means_ : array, shape (K, 2 d)
        Of offsets from the centre and velocities, in length and length/s.
    covariances_ : array, shape (K, 2 d, 2 d)
    field_ : MixtureField
        Works on offsets from the centre.

    References
    ----------
    Cohn, Ghahramani & Jordan, JAIR 4, 1996; Khansari-Zadeh & Billard, IEEE T-RO 27(5), 2011.

    Examples
    --------
    >>> from iflow_gym import load_lasa
    >>> system = GMR(n_components=4).fit(load_lasa("Angle"), seed=0)
    >>> system.guarantee.kind
    'none'
    """

    name: ClassVar[str] = "gmr"
    title: ClassVar[str] = "GMR"
    Config: ClassVar[type] = GMRConfig
    learns_cycles: ClassVar[bool] = True

    def _fit(self, demonstrations: Demonstrations, rng: np.random.Generator) -> None:
        centre = demonstrations.centre
        x = np.concatenate(demonstrations.positions) - centre
        v = np.concatenate(demonstrations.velocities)
        self._adopt(*fit_mixture(x, v, self.config, rng), centre)

    def _adopt(
        self, priors: FloatArray, means: FloatArray, covariances: FloatArray, centre: FloatArray
    ) -> None:
        self.priors_, self.means_, self.covariances_ = priors, means, covariances
        self.field_ = MixtureField.of_joint(priors, means, covariances)
        self._centre = centre

    def _velocity(self, x: FloatArray) -> FloatArray:
        return self.field_.velocity(x - self._centre)

    def _log_prob(self, x: FloatArray, x_next: FloatArray, dt: float) -> FloatArray:
        return self.field_.transition_log_prob(x - self._centre, x_next - self._centre, dt)

    @property
    def guarantee(self) -> Guarantee:
        """None: the regression knows nothing of the goal."""
        return Guarantee(
            "none",
            "a regression of velocities: nothing in it keeps the goal an equilibrium, attracts to "
            "it or to an orbit, or excludes other attractors and divergence elsewhere",
        )

    def _arrays(self) -> dict[str, np.ndarray[Any, Any]]:
        return {"priors": self.priors_, "means": self.means_, "covariances": self.covariances_}

    def _restore(self, arrays: Mapping[str, np.ndarray[Any, Any]]) -> None:
        priors, means, covariances = checked_mixture(arrays, self.n_dims_)
        self._adopt(priors, means, covariances, self.goal_)
