"""The search for the parameters of SEDS: where it starts, how it goes on, and what is kept.

Khansari-Zadeh & Billard 2011, section V and algorithm 2: EM gives the start, a solver with exact
gradients the optimum, BIC the number of Gaussians; of several starts the best is kept.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize
from sklearn.mixture import GaussianMixture

from iflow_gym.baselines.gmr import (
    check_components,
    expectation_maximisation,
    numbers_of_components,
    scaled_samples,
)
from iflow_gym.baselines.seds.config import Objective, SEDSConfig
from iflow_gym.baselines.seds.objective import (
    Samples,
    likelihood,
    mean_square_error,
    residual_covariances,
)
from iflow_gym.baselines.seds.parameters import Mixture, Parametrisation
from iflow_gym.baselines.subsets import evenly
from iflow_gym.demonstrations import FloatArray

ROOM = 2.0
"""Starts keep the margin so many times, and gains that a solver leaves short of it are moved there:
the boundary itself has no logarithm and no Cholesky factor."""

LEAST_PRIOR = 1e-12
"""Priors are in (0, 1]: one that the solver let vanish is kept at this."""


class Fitted(NamedTuple):
    """The mixture in the units of the demonstrations; see `SEDS` for the shapes."""

    priors: FloatArray
    centres: FloatArray
    spreads: FloatArray
    gains: FloatArray
    covariances: FloatArray


def fit_stable_mixture(
    x: FloatArray, v: FloatArray, config: SEDSConfig, rng: np.random.Generator
) -> Fitted:
    """Fit SEDS to offsets from the goal and velocities, shape (n, d) each.

    Positions are divided by their root mean square and velocities by theirs, so that neither the
    unit nor a rotation changes the fit; the mixture is scaled back exactly.
    """
    d = x.shape[1]
    both, scale = scaled_samples(x, v)
    seeds = rng.integers(2**31, size=config.n_initialisations + 1)
    n_components = config.n_components
    if n_components is None:
        n_components = choose_components(evenly(both, config.selection_samples), config, seeds[0])
    check_components(n_components, len(both))
    chosen = evenly(both, max(config.fit_samples, n_components))
    samples = Samples.of(chosen[:, :d], chosen[:, d:])
    form = Parametrisation(n_components, d, config.margin)
    mixtures = [_expectation_maximisation(chosen, n_components, config, s) for s in seeds[1:]]
    found = [
        solve(form.vector(start), form, samples, config, config.trial_iterations)
        for mixture in mixtures
        for start in starts(mixture, config.margin, config.regularisation, samples)
    ]
    value, vector = min(found, key=lambda entry: entry[0])
    solution = form.mixture(vector)
    if config.solver != "L-BFGS-B":
        form = Parametrisation(n_components, d, config.margin, by_construction=False)
        vector = form.vector(solution)
    _, vector = solve(vector, form, samples, config, config.max_iterations)
    last = made_feasible(form.mixture(vector), config.margin)
    # What counts is the objective where the constraints hold, not where the solver left them.
    if _objective(config.objective, form, samples, config)(form.vector(last))[0] <= value:
        solution = last
    return _in_units(solution, samples, config, scale[0], scale[-1])


def choose_components(both: FloatArray, config: SEDSConfig, seed: int) -> int:
    """Return the number of Gaussians of least BIC, from 2 to 10, or as many as samples allow.

    BIC is that of the likelihood under the constraints, with K (1 + 2 d (d + 1)) - 1 parameters,
    whichever the objective is: a mean square error has no likelihood.
    """
    n, d = len(both), both.shape[1] // 2
    samples = Samples.of(both[:, :d], both[:, d:])
    scores = {}
    for k in numbers_of_components(n):
        form = Parametrisation(k, d, config.margin)
        mixture = _expectation_maximisation(both, k, config, seed)
        start = starts(mixture, config.margin, config.regularisation, samples)[-1]
        value, _ = solve(
            form.vector(start), form, samples, config, config.trial_iterations, "likelihood"
        )
        scores[k] = 2 * n * value + (form.size - 1) * np.log(n)
    return min(scores, key=scores.__getitem__)


def _expectation_maximisation(
    both: FloatArray, n_components: int, config: SEDSConfig, seed: int
) -> GaussianMixture:
    return expectation_maximisation(both, n_components, 1, config.regularisation, int(seed))


def starts(
    mixture: GaussianMixture, margin: float, regularisation: float, samples: Samples
) -> list[Mixture]:
    """Return two feasible mixtures near one that EM found.

    The first is the paper's (algorithm 2): priors and mu_x stay, the blocks of the covariances are
    made diagonal, |Sigma_x|, |Sigma_v| and -|Sigma_vx|. The second keeps Sigma_x too and takes the
    gains of each Gaussian's own regression through the goal, with the symmetric part cut to be
    negative definite; the paper's forgets which way the motion turns.
    """
    k, d = mixture.means_.shape[0], mixture.means_.shape[1] // 2
    joint = mixture.covariances_
    of_x, across, of_v = joint[:, :d, :d], joint[:, d:, :d], joint[:, d:, d:]
    centres, logs = mixture.means_[:, :d], np.log(mixture.weights_)

    def diagonals(blocks: FloatArray) -> FloatArray:
        return np.abs(np.diagonal(blocks, axis1=1, axis2=2))

    variances = diagonals(of_x)
    rates = np.maximum(diagonals(across) / variances, ROOM * margin)
    remaining = np.maximum(diagonals(of_v) - rates**2 * variances, regularisation)
    eye = np.eye(d)
    diagonal = Mixture(
        logs,
        centres.copy(),
        eye / np.sqrt(variances)[:, None],
        eye / np.sqrt(remaining)[:, None],
        -eye * rates[:, None],
    )
    shares = mixture.predict_proba(np.concatenate([samples.x, samples.v], axis=1))
    sums = shares.T @ samples.products[:, 1 + d :]
    xx, vx, _ = (p.reshape(k, d, d) for p in np.split(sums, 3, axis=1))
    # Where a Gaussian's samples say nothing of a direction, it contracts at the rate of the rest.
    rate = max(ROOM * margin, -float(np.einsum("kii->", vx)) / float(np.einsum("kii->", xx)))
    small = regularisation * (shares.sum(axis=0)[:, None, None] + 1.0) * eye
    free = np.swapaxes(np.linalg.solve(xx + small, np.swapaxes(vx - rate * small, 1, 2)), 1, 2)
    precisions = np.asarray(np.linalg.inv(of_x))
    turning = Mixture(
        logs,
        centres.copy(),
        # The lower triangular W with Wᵀ W = Sigma^-1: a Cholesky factor read from the other end.
        _reversed_cholesky(precisions),
        np.zeros_like(free),
        _cut(free, ROOM * margin),
    )
    residuals = residual_covariances(turning, samples, regularisation)
    roots = _reversed_cholesky(np.asarray(np.linalg.inv(residuals)))
    turning = Mixture(logs, turning.centres, turning.whitening, roots, turning.gains)
    return [diagonal, turning]


def solve(
    vector: FloatArray,
    form: Parametrisation,
    samples: Samples,
    config: SEDSConfig,
    max_iterations: int,
    objective: Objective | None = None,
) -> tuple[float, FloatArray]:
    """Return the objective's value and the vector that the solver reached from `vector`.

    The objective is that of the settings unless another is named.
    """
    value_and_gradient = _objective(objective or config.objective, form, samples, config)
    method = "L-BFGS-B" if form.by_construction else config.solver
    options: dict[str, Any] = {"maxiter": max_iterations}
    extra: dict[str, Any] = {}
    if form.by_construction:
        options |= {"maxfun": 2 * max_iterations, "ftol": 1e-10, "gtol": 1e-7, "maxcor": 20}
    else:
        constraint = {"type": "ineq", "fun": form.constraint, "jac": form.constraint_jacobian}
        extra["constraints"] = [constraint]
        if config.solver == "SLSQP":
            options["ftol"] = 1e-10
    with np.errstate(all="ignore"):  # a step of the search that went too far
        result: Any = minimize(  # type: ignore[call-overload]
            value_and_gradient,
            vector,
            jac=True,
            method=method,
            bounds=form.bounds(),
            options=options,
            **extra,
        )
    if not np.isfinite(result.x).all() or not np.isfinite(result.fun):
        return np.inf, vector
    return float(result.fun), np.asarray(result.x)


def _objective(
    name: Objective, form: Parametrisation, samples: Samples, config: SEDSConfig
) -> Callable[[FloatArray], tuple[float, FloatArray]]:
    """Return the function of a vector that gives the objective's value and gradient."""
    if name == "likelihood":
        return lambda vector: likelihood(vector, form, samples, config.regularisation)
    return lambda vector: mean_square_error(vector, form, samples)


def made_feasible(mixture: Mixture, margin: float) -> Mixture:
    """Return the mixture with gains that keep the margin, moved no farther than it takes."""
    symmetric = (mixture.gains + np.swapaxes(mixture.gains, 1, 2)) / 2
    if np.linalg.eigvalsh(symmetric).max() <= -margin * (1 - 1e-9):
        return mixture
    return Mixture(
        mixture.log_priors,
        mixture.centres,
        mixture.whitening,
        mixture.precision_roots,
        _cut(mixture.gains, margin),
    )


def _cut(gains: FloatArray, margin: float) -> FloatArray:
    """Return the nearest gains, in Frobenius norm, with (A + Aᵀ) / 2 <= -margin."""
    symmetric = (gains + np.swapaxes(gains, 1, 2)) / 2
    values, axes = np.linalg.eigh(symmetric)
    kept = (axes * np.minimum(values, -margin)[:, None]) @ np.swapaxes(axes, 1, 2)
    return np.asarray(gains - symmetric + kept)


def _reversed_cholesky(matrices: FloatArray) -> FloatArray:
    """Return the lower triangular W with Wᵀ W = matrices, shape (K, d, d)."""
    flipped = np.linalg.cholesky(matrices[:, ::-1, ::-1])
    return np.swapaxes(flipped[:, ::-1, ::-1], 1, 2)


def _in_units(
    mixture: Mixture, samples: Samples, config: SEDSConfig, length: float, speed: float
) -> Fitted:
    covariances = np.asarray(np.linalg.inv(_squared(mixture.precision_roots)))
    if config.objective == "mse":
        covariances = residual_covariances(mixture, samples, config.regularisation)
    spreads = np.asarray(np.linalg.inv(_squared(mixture.whitening)))
    priors = np.maximum(np.exp(mixture.normalised), LEAST_PRIOR)
    return Fitted(
        priors / priors.sum(),
        mixture.centres * length,
        _symmetric(spreads) * length**2,
        mixture.gains * (speed / length),
        _symmetric(covariances) * speed**2,
    )


def _squared(roots: FloatArray) -> FloatArray:
    return np.swapaxes(roots, 1, 2) @ roots


def _symmetric(matrices: FloatArray) -> FloatArray:
    return (matrices + np.swapaxes(matrices, 1, 2)) / 2
