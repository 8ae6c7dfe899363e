"""V, a weighted sum of asymmetric quadratic functions (WSAQF), and how it is learned.

Khansari-Zadeh & Billard, "Learning control Lyapunov function to ensure stability of dynamical
system-based robot reaching motions", Robotics and Autonomous Systems 62(6), 2014:

    V(x) = xᵀ P_0 x + sum_l beta_l (xᵀ P_l (x - mu_l))²,   beta_l = 1 where the bracket is >= 0

(eq. (3)), x the offset from the goal, every P positive definite. V is continuously differentiable,
and along every ray from the goal it grows without end, so that the goal is its only minimum. P need
not be more than symmetric: an asymmetric one is a symmetric one with another mu.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from iflow_gym.demonstrations import FloatArray

LEAST_SHARE = 0.02
"""a in P = T Tᵀ + a tr(T Tᵀ) I: no eigenvalue in the plane is below about a fiftieth of the sum (in
the authors' demonstration, a tenth). Without it level sets are slits, along which a state may go
far away before V lets it return."""

ROUNDS = (8, 20), (3, 60), (1, 300)
"""How many places where a new asymmetric term is tried go on, and for how many iterations more."""

LEAST_SPEED = 0.05
"""Of the fastest sample: a hand that hesitates has no direction to learn from."""

LEAST_LEFT = 1e-3
"""Of w: nearer than this to -w, there is nothing left to gain but rounding."""

NEWTON_STEPS = 60
"""At most; two or three are usual."""

NEWTON_TOLERANCE = 1e-8
"""Of s, and how large the last step may be: Newton's steps from above shrink with their square."""

TINY = float(np.finfo(np.float64).tiny)
"""Keeps a slope or a norm that is 0 from being divided by."""


class Energy:
    """V, ready for many calls.

    Parameters
    ----------
    matrices : array, shape (L + 1, d, d)
        P_0 .. P_L, symmetric and positive definite.
    centres : array, shape (L, d)
        mu_1 .. mu_L.
    """

    def __init__(self, matrices: FloatArray, centres: FloatArray) -> None:
        self.matrices, self.centres = matrices, centres
        self._stacked = matrices.reshape(-1, matrices.shape[-1])
        self._shifts = shifted(matrices, centres)
        self._half_shifts = 0.5 * self._shifts.T

    def _rays(self, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return P_l x, shape (L + 1, d, n), xᵀ P_l x and xᵀ P_l mu_l, shape (L + 1, n).

        At s x the bracket of term l is s (s xᵀ P_l x - xᵀ P_l mu_l). Terms lead here: sums over the
        few of them then run along memory.
        """
        columns = np.ascontiguousarray(x.T)
        products = (self._stacked @ columns).reshape(*self.matrices.shape[:2], -1)
        return products, np.einsum("ldn,dn->ln", products, columns), self._shifts @ columns

    def value(self, x: FloatArray) -> FloatArray:
        """Return V, shape (n,), of offsets x, shape (n, d)."""
        _, squares, slopes = self._rays(x)
        return _sum(np.maximum(squares - slopes, 0.0))

    def value_and_gradient(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return V, shape (n,), and its gradient, shape (n, d)."""
        products, squares, slopes = self._rays(x)
        brackets = np.maximum(squares - slopes, 0.0)
        value = _sum(brackets)
        weights = 4.0 * brackets
        weights[0] = 2.0
        gradient = np.einsum("ln,ldn->dn", weights, products)
        gradient -= self._half_shifts @ weights
        return value, gradient.T

    def lowered(self, x: FloatArray, level: FloatArray) -> FloatArray:
        """Return x where V(x) <= level, shape (n,), and else s x, 0 <= s < 1, V(s x) = level.

        The root of V(s x) is the length of a vector whose components are convex and increasing in
        s, and so is convex and increasing itself: from above, Newton's method falls to the s where
        it is that of the level. It starts where the part of V(s x) that is s² times a number, and
        which V exceeds, reaches the level: near the goal that is nearly all of V.
        """
        _, squares, slopes = self._rays(x)
        value = _sum(np.maximum(squares - slopes, 0.0))
        above = np.flatnonzero(value > level)
        if not len(above):
            return x
        if len(above) < len(x):
            squares, slopes, level = squares[:, above], slopes[:, above], level[above]
        outward = np.minimum(slopes, 0.0)
        least = squares[0] + np.einsum("ln,ln->n", outward, outward)
        roots = np.sqrt(level)
        s = np.minimum(roots / np.sqrt(least), 1.0)  # 0 where the level has underflown to it
        for _ in range(NEWTON_STEPS):
            reached = s * squares
            rates = reached - slopes
            brackets = np.maximum(s * rates, 0.0)
            rates += reached
            rates[0] *= 0.5
            value = _sum(brackets)
            brackets[0] = 1.0
            slope = np.einsum("ln,ln->n", brackets, rates) + TINY
            change = (value - roots * np.sqrt(value)) / slope
            s -= np.maximum(change, 0.0)
            if (change <= NEWTON_TOLERANCE * s).all():
                break
        fractions = np.ones(len(x))
        fractions[above] = s
        return np.asarray(fractions[:, None] * x)


def _sum(brackets: FloatArray) -> FloatArray:
    """Return V, shape (n,), from the brackets where they count, shape (L + 1, n)."""
    terms = brackets[1:]
    return np.asarray(brackets[0] + np.einsum("ln,ln->n", terms, terms))


def shifted(matrices: FloatArray, centres: FloatArray) -> FloatArray:
    """Return P_l mu_l, shape (L + 1, d), with 0 for the first, which has no mu."""
    shifts = np.zeros(matrices.shape[:2])
    shifts[1:] = (matrices[1:] @ centres[:, :, None])[:, :, 0]
    return shifts


@dataclass(frozen=True)
class EnergyForm:
    """Between V and a vector: mu_l, and lower triangular T_l, P_l = T_l T_lᵀ + a tr(T_l T_lᵀ) I."""

    n_terms: int
    n_dims: int

    @cached_property
    def _lower(self) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
        rows, columns = np.tril_indices(self.n_dims)
        return rows, columns

    @property
    def size(self) -> int:
        """Length of the vector."""
        d = self.n_dims
        return self.n_terms * d + (self.n_terms + 1) * d * (d + 1) // 2

    def roots_and_centres(self, vector: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return T, shape (L + 1, d, d), and mu, shape (L, d)."""
        n, d = self.n_terms, self.n_dims
        roots = np.zeros((n + 1, d, d))
        rows, columns = self._lower
        roots[:, rows, columns] = vector[n * d :].reshape(n + 1, -1)
        return roots, vector[: n * d].reshape(n, d)

    def matrices(self, roots: FloatArray) -> FloatArray:
        """Return P, shape (L + 1, d, d)."""
        matrices = roots @ np.swapaxes(roots, 1, 2)
        least = LEAST_SHARE * np.einsum("lii->l", matrices)
        matrices[:, range(self.n_dims), range(self.n_dims)] += least[:, None]
        return matrices

    def energy(self, vector: FloatArray) -> Energy:
        """Return V."""
        roots, centres = self.roots_and_centres(vector)
        return Energy(self.matrices(roots), centres)

    def flattened(self, roots: FloatArray, centres: FloatArray) -> FloatArray:
        """Return the vector of T and mu, or of a gradient with respect to them."""
        rows, columns = self._lower
        return np.concatenate([centres.ravel(), roots[:, rows, columns].ravel()])


def objective(
    vector: FloatArray, form: EnergyForm, x: FloatArray, directions: FloatArray, weight: float
) -> tuple[float, FloatArray]:
    """Return the mean of (1 + w)/2 sign(psi) psi² + (1 - w)/2 psi² and its gradient (eq. (7)).

    Parameters
    ----------
    vector : array, shape (size,)
    form : EnergyForm
    x : array, shape (n, d)
        Offsets from the goal.
    directions : array, shape (n, d)
        Unit vectors along the velocities; psi is the cosine of the angle to the gradient of V.
    weight : float
        w: psi² counts where psi > 0, -w psi² where V descends.
    """
    n, d = len(x), form.n_dims
    roots, centres = form.roots_and_centres(vector)
    matrices = form.matrices(roots)
    shifts = shifted(matrices, centres)
    # Samples are columns here: sums over the few terms and dimensions then run along memory.
    x, directions = x.T, directions.T
    products = (matrices.reshape(-1, d) @ x).reshape(-1, d, n)
    brackets = (products * x).sum(axis=1) - shifts @ x
    inner = 2.0 * products - shifts[:, :, None]
    weights = 2.0 * np.maximum(brackets, 0.0)
    weights[0] = 1.0
    gradient = (weights[:, None] * inner).sum(axis=0)
    norms = np.maximum(np.sqrt((gradient**2).sum(axis=0)), TINY)
    unit = gradient / norms
    psi = (unit * directions).sum(axis=0)
    signed = np.where(psi > 0, 1.0, -weight)
    value = float(np.mean(signed * psi**2))
    # d psi = (v - psi g) · dg / |g|, g the unit gradient.
    pull = (2.0 * signed * psi / (norms * n)) * (directions - psi * unit)
    # g = sum_l w_l (2 P_l x - P_l mu_l), w_l = 2 max(q_l, 0), q_l = xᵀ P_l (x - mu_l).
    along = 2.0 * (inner * pull).sum(axis=1) * (brackets > 0)
    along[0] = 0.0
    of_products = 2.0 * weights[:, None] * pull + along[:, None] * x
    of_matrices = (of_products.reshape(-1, n) @ x.T).reshape(roots.shape)
    of_shifts = -(weights @ pull.T) - along @ x.T
    of_centres = (matrices[1:] @ of_shifts[1:, :, None])[:, :, 0]
    of_matrices[1:] += of_shifts[1:, :, None] * centres[:, None]
    of_roots = (of_matrices + np.swapaxes(of_matrices, 1, 2)) @ roots
    of_roots += 2.0 * LEAST_SHARE * np.einsum("lii->l", of_matrices)[:, None, None] * roots
    return value, form.flattened(of_roots, of_centres)


def _start(
    wider: EnergyForm,
    roots: FloatArray,
    centres: FloatArray,
    x: FloatArray,
    rng: np.random.Generator,
    fresh: bool,
) -> FloatArray:
    """Return a start with one term more: what was found and a new term, or all terms anew.

    New terms have their mu near samples, and random shapes and sizes.
    """
    n_new = wider.n_terms if fresh else 1
    d = wider.n_dims
    where = x[rng.integers(len(x), size=n_new)] * rng.uniform(0.2, 2.0, size=(n_new, 1))
    sizes = np.exp(rng.uniform(np.log(0.1), np.log(3.0), size=(n_new, 1, 1)))
    shapes = sizes * (np.eye(d) + 0.5 * np.tril(rng.normal(size=(n_new, d, d))))
    if fresh:
        roots, centres = roots[:1], centres[:0]
    return wider.flattened(np.concatenate([roots, shapes]), np.concatenate([centres, where]))


def learn_energies(
    x: FloatArray,
    v: FloatArray,
    weights: Sequence[float],
    n_searches: int,
    max_terms: int,
    least_gain: float,
    rng: np.random.Generator,
) -> list[Energy]:
    """Learn V for every w, `n_searches` times each: all those of `learn_energy`, none twice."""
    found: list[Energy] = []
    for weight in weights:
        for i in range(n_searches):
            energies = learn_energy(x, v, max_terms, least_gain, weight, rng)
            # Without asymmetric terms nothing is drawn: the first is the same in every search.
            found += energies[min(i, 1) :]
    return found


def learn_energy(
    x: FloatArray,
    v: FloatArray,
    max_terms: int,
    least_gain: float,
    weight: float,
    rng: np.random.Generator,
) -> list[Energy]:
    """Learn V: one asymmetric term after another, as long as the objective gains.

    Parameters
    ----------
    x, v : arrays, shape (n, d)
        Offsets from the goal, of root mean square 1, and velocities of any unit. Samples that
        lie at the goal, or are slower than `LEAST_SPEED`, are left out.
    max_terms : int
        Most asymmetric terms.
    least_gain : float
        A further term has to lower the objective by this fraction of its distance from the
        least that it could be, -w.
    weight : float
        w of `objective`.
    rng : numpy Generator
        Draws where new terms are tried.

    Returns
    -------
    list of Energy
        V with 0, 1, .. terms, up to the last that gained; each scaled so that its mean over x is 1.
    """
    d = x.shape[1]
    speeds, distances = np.linalg.norm(v, axis=1), np.linalg.norm(x, axis=1)
    moving = (speeds > LEAST_SPEED * speeds.max()) & (distances > 1e-9 * distances.max())
    x, directions = x[moving], v[moving] / speeds[moving, None]
    x, directions = np.asfortranarray(x), np.asfortranarray(directions)  # `objective` takes columns

    def search(vector: FloatArray, form: EnergyForm, iterations: int) -> tuple[float, FloatArray]:
        result = minimize(
            objective,
            vector,
            args=(form, x, directions, weight),
            jac=True,
            method="L-BFGS-B",
            options={"maxiter": iterations, "ftol": 1e-12, "gtol": 1e-9, "maxcor": 20},
        )
        return float(result.fun), np.asarray(result.x)

    form = EnergyForm(0, d)
    start = form.flattened(np.eye(d)[None], np.empty((0, d)))
    best, vector = search(start, form, ROUNDS[-1][1])
    found = [form.energy(vector)]
    for n_terms in range(1, max_terms + 1):
        roots, centres = form.roots_and_centres(vector)
        wider = EnergyForm(n_terms, d)
        starts = [_start(wider, roots, centres, x, rng, i % 2 == 0) for i in range(ROUNDS[0][0])]
        for n_kept, iterations in ROUNDS:
            reached = [search(start, wider, iterations) for start in starts[:n_kept]]
            reached.sort(key=lambda entry: entry[0])
            starts = [place for _, place in reached]
        value = reached[0][0]
        if best - value < least_gain * max(best + weight, LEAST_LEFT * weight):
            break
        best, vector, form = value, starts[0], wider
        found.append(form.energy(vector))
    return [_scaled(energy, x) for energy in found]


def _scaled(energy: Energy, x: FloatArray) -> Energy:
    """Return V over its mean at the samples."""
    scale = 1.0 / float(energy.value(x).mean())
    matrices = energy.matrices * np.sqrt(scale)
    matrices[0] *= np.sqrt(scale)
    return Energy(matrices, energy.centres)
