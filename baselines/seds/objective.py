"""The two objectives of SEDS, with exact gradients.

Khansari-Zadeh & Billard 2011: the likelihood, eq. (17), and the mean square error, eq. (19). The
posteriors h_k depend on the parameters in both; a "SEDS" that freezes them is another method.

A Gaussian's log-density is linear in the products of a sample's coordinates, so that all densities
are one product of two matrices, and so are the sums that the gradient needs.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from iflow_gym.baselines.seds.parameters import Mixture, Parametrisation
from iflow_gym.demonstrations import FloatArray


class Samples(NamedTuple):
    """Positions and velocities in their scale, and the products of their coordinates."""

    x: FloatArray
    """Offsets from the goal, shape (n, d)."""
    v: FloatArray
    """Velocities, shape (n, d)."""
    products: FloatArray
    """1, x, x xᵀ, v xᵀ, v vᵀ, shape (n, 1 + d + 3 d²)."""

    @classmethod
    def of(cls, x: FloatArray, v: FloatArray) -> Samples:
        """Return samples with their products."""

        def outer(a: FloatArray, b: FloatArray) -> FloatArray:
            return (a[:, :, None] * b[:, None]).reshape(len(a), -1)

        columns = [np.ones((len(x), 1)), x, outer(x, x), outer(v, x), outer(v, v)]
        return cls(x, v, np.concatenate(columns, axis=1))


def likelihood(
    vector: FloatArray, form: Parametrisation, samples: Samples, regularisation: float
) -> tuple[float, FloatArray]:
    """Return minus the mean log-likelihood, eq. (17), and its gradient.

    Parameters
    ----------
    vector : array, shape (size,)
    form : Parametrisation
    samples : Samples
    regularisation : float
        Variance that every sample is taken to be uncertain by, in x and in v: each component's
        log-density is its mean over that noise. Without it the likelihood of samples that lie on a
        line, or of an exactly linear motion, has no maximum.
    """
    mixture = form.mixture(vector)
    logs = samples.products @ _coefficients(mixture, regularisation).T
    top = logs.max(axis=1, keepdims=True)
    share = np.exp(logs - top)
    total = share.sum(axis=1, keepdims=True)
    share /= total
    value = -float(np.mean(top + np.log(total)))
    sums = share.T @ samples.products / len(samples.x)
    return value, form.pull_back(vector, _minus_gradient(mixture, sums, regularisation))


def mean_square_error(
    vector: FloatArray, form: Parametrisation, samples: Samples
) -> tuple[float, FloatArray]:
    """Return half the mean of ‖f(x) - v‖², eq. (19), and its gradient.

    Parameters are `likelihood`'s. The velocities' covariances do not matter to it.
    """
    mixture = form.mixture(vector)
    x, v, products = samples
    n, d = x.shape
    shares = field_weights(mixture, products[:, : 1 + d + d * d])
    each = np.einsum("kij,nj->nki", mixture.gains, x)
    field = np.einsum("nk,nki->ni", shares, each)
    error = field - v
    along = (each @ error[:, :, None])[:, :, 0]
    of_logs = shares * (along - (error * field).sum(axis=1, keepdims=True)) / n
    of_products = np.zeros((form.n_components, products.shape[1]))
    of_products[:, : 1 + d + d * d] = -of_logs.T @ products[:, : 1 + d + d * d]
    gradient = _minus_gradient(mixture, of_products, 0.0)
    outer = (error[:, :, None] * x[:, None]).reshape(n, -1)
    of_gains = (shares.T @ outer).reshape(-1, d, d) / n
    gradient = Mixture(
        gradient.log_priors,
        gradient.centres,
        gradient.whitening,
        np.zeros_like(of_gains),
        of_gains,
    )
    return 0.5 * float(np.mean((error * error).sum(axis=1))), form.pull_back(vector, gradient)


def field_weights(mixture: Mixture, products: FloatArray) -> FloatArray:
    """Return h_k(x), shape (n, K), of the products 1, x, x xᵀ."""
    logs = products @ _coefficients_of_x(mixture).T
    logs -= logs.max(axis=1, keepdims=True)
    np.exp(logs, out=logs)
    logs /= logs.sum(axis=1, keepdims=True)
    return logs


def residual_covariances(mixture: Mixture, samples: Samples, regularisation: float) -> FloatArray:
    """Return Cov(v | x, k), shape (K, d, d), that the field's own weights h_k leave."""
    d = samples.x.shape[1]
    shares = field_weights(mixture, samples.products[:, : 1 + d + d * d])
    sums = shares.T @ samples.products / len(samples.x)
    mass = np.maximum(sums[:, :1, None], np.finfo(np.float64).tiny)
    return _residuals(mixture, sums) / mass + regularisation * np.eye(d)


def _precisions(roots: FloatArray) -> FloatArray:
    return np.swapaxes(roots, 1, 2) @ roots


def _log_diagonals(roots: FloatArray) -> FloatArray:
    return np.asarray(np.log(np.diagonal(roots, axis1=1, axis2=2)).sum(axis=1))


def _coefficients_of_x(mixture: Mixture, regularisation: float = 0.0) -> FloatArray:
    """Return what multiplies 1, x and x xᵀ in log pi_k N(x; mu_k, Sigma_k)."""
    k, d = mixture.centres.shape
    precisions = _precisions(mixture.whitening)
    linear = np.einsum("kij,kj->ki", precisions, mixture.centres)
    constant = (
        mixture.normalised
        + _log_diagonals(mixture.whitening)
        - 0.5 * d * np.log(2 * np.pi)
        - 0.5 * (linear * mixture.centres).sum(axis=1)
        - 0.5 * regularisation * (mixture.whitening**2).sum(axis=(1, 2))
    )
    square = -0.5 * precisions.reshape(k, -1)
    return np.concatenate([constant[:, None], linear, square], axis=1)


def _coefficients(mixture: Mixture, regularisation: float) -> FloatArray:
    """Return what multiplies the products in log pi_k N(x; mu_k, Sigma_k) N(v; A_k x, C_k)."""
    k, d = mixture.centres.shape
    of_x = _coefficients_of_x(mixture, regularisation)
    roots = mixture.precision_roots
    of_x[:, 0] += _log_diagonals(roots) - 0.5 * d * np.log(2 * np.pi)
    of_x[:, 0] -= 0.5 * regularisation * (roots**2).sum(axis=(1, 2))
    precisions = _precisions(roots)
    across = precisions @ mixture.gains
    of_x[:, 1 + d :] -= 0.5 * (np.swapaxes(mixture.gains, 1, 2) @ across).reshape(k, -1)
    return np.concatenate([of_x, across.reshape(k, -1), -0.5 * precisions.reshape(k, -1)], axis=1)


def _residuals(mixture: Mixture, sums: FloatArray) -> FloatArray:
    """Return the weighted sums of (v - A x)(v - A x)ᵀ, shape (K, d, d)."""
    k, d = mixture.centres.shape
    xx, vx, vv = (p.reshape(k, d, d) for p in np.split(sums[:, 1 + d :], 3, axis=1))
    gains = mixture.gains
    across = vx @ np.swapaxes(gains, 1, 2)
    return vv - across - np.swapaxes(across, 1, 2) + gains @ xx @ np.swapaxes(gains, 1, 2)


def _minus_gradient(mixture: Mixture, sums: FloatArray, regularisation: float) -> Mixture:
    """Return minus the gradient of sum_k c_k · sums_k, c_k the coefficients of `sums`."""
    k, d = mixture.centres.shape
    mass, first = sums[:, 0], sums[:, 1 : 1 + d]
    xx, vx, _ = (p.reshape(k, d, d) for p in np.split(sums[:, 1 + d :], 3, axis=1))
    centres, whitening, roots = mixture.centres, mixture.whitening, mixture.precision_roots
    noise = regularisation * mass[:, None, None] * np.eye(d)
    moved = first[:, :, None] * centres[:, None]
    around = xx - moved - np.swapaxes(moved, 1, 2) + noise
    around += mass[:, None, None] * centres[:, :, None] * centres[:, None]
    left = _residuals(mixture, sums) + noise
    mass_over = mass[:, None] / np.diagonal(whitening, axis1=1, axis2=2)
    of_whitening, of_roots = whitening @ around, roots @ left
    of_whitening[:, range(d), range(d)] -= mass_over
    of_roots[:, range(d), range(d)] -= mass[:, None] / np.diagonal(roots, axis1=1, axis2=2)
    pull = first - mass[:, None] * centres
    return Mixture(
        np.exp(mixture.normalised) * mass.sum() - mass,
        -np.einsum("kij,kj->ki", _precisions(whitening), pull),
        of_whitening,
        of_roots,
        -_precisions(roots) @ (vx - mixture.gains @ xx),
    )
