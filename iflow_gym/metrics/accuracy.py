"""How closely a reproduction follows its demonstration: positions and teacher-forced velocities.

The definitions are those of the accuracy table in METRICS.md. The argument order is always
(demonstration, reproduction) or (demonstrated, predicted), and every function takes one pair of
shape (T, d), which gives a float, or B pairs of equal length as (B, T, d), which give shape (B,).

A demonstration must be finite. A reproduction that is not finite everywhere, or so far away that
its score overflows float64, scores infinity: it is neither dropped nor an error, and nothing warns.

References
----------
- T. Eiter, H. Mannila, "Computing discrete Fréchet distance", TU Wien CD-TR 94/64, 1994.
- H. Sakoe, S. Chiba, "Dynamic programming algorithm optimization for spoken word recognition",
  IEEE T-ASSP 26(1), 1978.
- S. M. Khansari-Zadeh, A. Billard, "Learning stable nonlinear dynamical systems with Gaussian
  mixture models", IEEE T-RO 27(5), 2011 (SEDS).
- S. M. Khansari-Zadeh, A. Billard, "Learning control Lyapunov function to ensure stability of
  dynamical system-based robot reaching motions", RAS 62(6), 2014 (CLF-DM).
- N. Figueroa, A. Billard, "A physically-consistent Bayesian non-parametric mixture model for
  dynamical system learning", CoRL 2018 (LPV-DS).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from iflow_gym.metrics._validation import BoolArray, FloatArray, Pairs, Scores, as_pairs

SEDS_DIRECTION_WEIGHT = 0.6
"""r of SEDS eq. (23)."""
SEDS_SPEED_WEIGHT = 0.4
"""q of SEDS eq. (23)."""
SEDS_RELATIVE_EPSILON = 1e-4
"""eps of SEDS eq. (23), as a fraction of the demonstration's mean squared speed."""

_BLOCK = 2**15  # distances held at once by the anti-diagonal sweep: 256 kB, which stays in cache
_MAX_DIAGONALS = 64


def rmse(demonstration: ArrayLike, reproduction: ArrayLike) -> Scores:
    r"""Root of the mean squared distance between samples of equal index.

    .. math:: \sqrt{\tfrac{1}{T} \sum_t \lVert \hat x_t - x_t \rVert^2}

    Parameters
    ----------
    demonstration
        Positions x, shape (T, d) or (B, T, d), in units of length.
    reproduction
        Positions x^ of the rollout from x_0, the same shape.

    Returns
    -------
    float or array of shape (B,)
        In units of length. There is no division by d: it is a distance, not one per coordinate.

    Raises
    ------
    ValueError
        If the shapes differ, or the demonstration is not finite.
    """
    return _root_mean_square(as_pairs(demonstration, reproduction))


def frechet(demonstration: ArrayLike, reproduction: ArrayLike) -> Scores:
    r"""Discrete Fréchet distance between the full sequences, Euclidean.

    The least, over the couplings of the two sequences, of the longest link of the coupling:

    .. math:: c_{ij} = \max(\lVert x_i - \hat x_j \rVert,
        \min(c_{i-1,j}, c_{i,j-1}, c_{i-1,j-1})), \qquad F = c_{T-1,S-1}

    Parameters
    ----------
    demonstration
        Positions, shape (T, d) or (B, T, d), in units of length.
    reproduction
        Positions, shape (S, d) or (B, S, d); S may differ from T.

    Returns
    -------
    float or array of shape (B,)
        In units of length. Symmetric in its arguments.

    Raises
    ------
    ValueError
        If batch or dimension differ, or the demonstration is not finite.

    Notes
    -----
    Eiter & Mannila 1994, their recursion run along anti-diagonals: O(T S) time, and memory for
    three diagonals and a block of distances. The recursion only compares, so it runs on squared
    distances, and one root is taken at the end.
    """
    pairs = as_pairs(demonstration, reproduction, equal_lengths=False)
    return pairs.scores(np.sqrt(_sweep(pairs, np.maximum, root=False)))


def dtw(demonstration: ArrayLike, reproduction: ArrayLike) -> Scores:
    r"""Dynamic time warping distance for each sample of the demonstration ("DTW / sample").

    The least sum of Euclidean distances over the warping paths from (0, 0) to (T-1, S-1) with the
    steps (1, 0), (0, 1) and (1, 1), all of weight one and without a window, divided by T:

    .. math:: c_{ij} = \lVert x_i - \hat x_j \rVert + \min(c_{i-1,j}, c_{i,j-1}, c_{i-1,j-1}),
        \qquad \mathrm{DTW} = c_{T-1,S-1} / T

    Parameters
    ----------
    demonstration
        Positions, shape (T, d) or (B, T, d), in units of length.
    reproduction
        Positions, shape (S, d) or (B, S, d); S may differ from T.

    Returns
    -------
    float or array of shape (B,)
        In units of length. The divisor is the demonstration's T, so that the value is symmetric in
        its arguments only where the lengths are equal.

    Raises
    ------
    ValueError
        If batch or dimension differ, or the demonstration is not finite.

    Notes
    -----
    Sakoe & Chiba 1978, with the unweighted steps that libraries call "symmetric1". Libraries
    disagree on the rest (sum, squared distances, square root): multiply by T for the plain sum.
    """
    pairs = as_pairs(demonstration, reproduction, equal_lengths=False)
    return pairs.scores(_sweep(pairs, np.add, root=True) / pairs.demonstration.shape[1])


def swept_area(demonstration: ArrayLike, reproduction: ArrayLike) -> Scores:
    r"""Area swept between demonstration and reproduction, unsigned and exact, in 2-D.

    .. math:: \sum_{t=0}^{T-2} A(\hat x_t, \hat x_{t+1}, x_{t+1}, x_t)

    A is the area of the tetragon with the vertices in this order. Where two opposite sides cross,
    be it the two steps or the two links between the curves, it is the area of the two triangles
    that they form. Concave tetragons count as they are, and tetragons on a line count nothing.

    Parameters
    ----------
    demonstration
        Positions x, shape (T, 2) or (B, T, 2) with T >= 2, in units of length.
    reproduction
        Positions x^, the same shape.

    Returns
    -------
    float or array of shape (B,)
        In units of length squared. Symmetric in its arguments. An area that is swept twice counts
        twice, and a reproduction that runs along the demonstration at another pace sweeps nothing
        where the demonstration is straight.

    Raises
    ------
    ValueError
        If the shapes differ or are not 2-D, T < 2, or the demonstration is not finite.

    Notes
    -----
    CLF-DM 2014, eq. (14), for one demonstration: the mean over demonstrations is the caller's.
    """
    pairs = as_pairs(
        demonstration,
        reproduction,
        dimension=2,
        hint="use swept_surface for 3-D",
        min_samples=2,
    )
    x, y = pairs.demonstration, pairs.reproduction
    with np.errstate(over="ignore", invalid="ignore"):
        return pairs.scores(_tetragon_area(y[:, :-1], y[:, 1:], x[:, 1:], x[:, :-1]).sum(axis=-1))


def swept_surface(demonstration: ArrayLike, reproduction: ArrayLike) -> Scores:
    r"""Surface swept between demonstration and reproduction in 3-D, each tetragon as two triangles.

    .. math:: \sum_{t=0}^{T-2} \min(|abc| + |acd|, |abd| + |bcd|), \quad
        (a, b, c, d) = (\hat x_t, \hat x_{t+1}, x_{t+1}, x_t)

    Four points in space span no unique surface. Of the two ways to cut the tetragon along a
    diagonal, the one with the smaller surface is taken: it does not depend on the order of the
    arguments, and it is the area of a flat tetragon, convex or concave, whose sides do not cross.
    Flat tetragons whose sides do cross count more here than in ``swept_area``.

    Parameters
    ----------
    demonstration
        Positions x, shape (T, 3) or (B, T, 3) with T >= 2, in units of length.
    reproduction
        Positions x^, the same shape.

    Returns
    -------
    float or array of shape (B,)
        In units of length squared. Symmetric in its arguments.

    Raises
    ------
    ValueError
        If the shapes differ or are not 3-D, T < 2, or the demonstration is not finite.

    Notes
    -----
    Ours: the counterpart of CLF-DM 2014, eq. (14), in space, hence another name.
    """
    pairs = as_pairs(
        demonstration,
        reproduction,
        dimension=3,
        hint="use swept_area for 2-D",
        min_samples=2,
    )
    x, y = pairs.demonstration, pairs.reproduction
    a, b, c, d = y[:, :-1], y[:, 1:], x[:, 1:], x[:, :-1]
    with np.errstate(over="ignore", invalid="ignore"):
        along_ac = _triangle_area(a, b, c) + _triangle_area(a, c, d)
        along_bd = _triangle_area(a, b, d) + _triangle_area(b, c, d)
        return pairs.scores(np.minimum(along_ac, along_bd).sum(axis=-1))


def seds_error(demonstrated: ArrayLike, predicted: ArrayLike) -> Scores:
    r"""Error of direction and speed of teacher-forced velocities, as SEDS reports it.

    .. math:: \frac{1}{T} \sum_t \sqrt{
        r \Big(1 - \frac{v_t^\top \hat v_t}{\lVert v_t \rVert \lVert \hat v_t \rVert}\Big)^2
        + q \frac{\lVert v_t - \hat v_t \rVert^2}{\lVert v_t \rVert \lVert v_t \rVert + \epsilon}}

    with r = 0.6 and q = 0.4. The second denominator has no hat.

    Parameters
    ----------
    demonstrated
        Velocities v_t, shape (T, d) or (B, T, d), in length/s.
    predicted
        Velocities v^_t = f(x_t) at the demonstration's own samples, the same shape.

    Returns
    -------
    float or array of shape (B,)
        Without a unit.

    Raises
    ------
    ValueError
        If the shapes differ, the demonstrated velocities are not finite, or a demonstration has no
        velocity at all.

    Notes
    -----
    SEDS 2011, eq. (23), for one demonstration. The paper has eps "very small" and no value. Here it
    is 1e-4 times the demonstration's mean squared speed, a hundredth of its typical speed, so that
    the error has no unit indeed (millimetres and metres agree) and the samples at rest, with which
    each recording ends, do not drown the rest: such a sample weighs at most
    sqrt(q) 100 ‖v - v^‖ / v_rms. Where an angle is undefined, see ``direction_error``.
    """
    pairs = as_pairs(demonstrated, predicted, quantity="velocities")
    v, v_hat = pairs.demonstration, pairs.reproduction
    with np.errstate(over="ignore", invalid="ignore"):
        squared_speed = _squared_norm(v)
        epsilon = SEDS_RELATIVE_EPSILON * squared_speed.mean(axis=-1, keepdims=True)
        if not (epsilon > 0).all():
            raise ValueError(
                "Expected a demonstration that moves, got velocities that are all zero"
            )
        speed_error = _squared_norm(v - v_hat) / (squared_speed + epsilon)
        direction = SEDS_DIRECTION_WEIGHT * _one_minus_cosine(v, v_hat) ** 2
        return pairs.scores(np.sqrt(direction + SEDS_SPEED_WEIGHT * speed_error).mean(axis=-1))


def direction_error(demonstrated: ArrayLike, predicted: ArrayLike) -> Scores:
    r"""Mean error of direction of teacher-forced velocities.

    .. math:: \frac{1}{T} \sum_t \Big| 1 -
        \frac{v_t^\top \hat v_t}{\lVert v_t \rVert \lVert \hat v_t \rVert} \Big|

    Parameters
    ----------
    demonstrated
        Velocities v_t, shape (T, d) or (B, T, d), in length/s.
    predicted
        Velocities v^_t = f(x_t) at the demonstration's own samples, the same shape.

    Returns
    -------
    float or array of shape (B,)
        Without a unit, between 0 (the same directions) and 2 (opposite ones).

    Raises
    ------
    ValueError
        If the shapes differ, or the demonstrated velocities are not finite.

    Notes
    -----
    LPV-DS (Figueroa & Billard 2018), where the angle to a velocity of zero is left open. Here:

    - a demonstrated velocity of exactly zero has no direction to miss: the sample counts 0, and
      stays in the mean (every LASA recording ends with one such sample);
    - a predicted velocity of exactly zero where the demonstration moves has no direction either:
      it counts 1, like one at right angles.
    """
    pairs = as_pairs(demonstrated, predicted, quantity="velocities")
    error = _one_minus_cosine(pairs.demonstration, pairs.reproduction)
    return pairs.scores(error.mean(axis=-1))


def velocity_rmse(demonstrated: ArrayLike, predicted: ArrayLike) -> Scores:
    r"""Root of the mean squared error of teacher-forced velocities.

    .. math:: \sqrt{\tfrac{1}{T} \sum_t \lVert v_t - \hat v_t \rVert^2}

    Parameters
    ----------
    demonstrated
        Velocities v_t, shape (T, d) or (B, T, d), in length/s.
    predicted
        Velocities v^_t = f(x_t) at the demonstration's own samples, the same shape.

    Returns
    -------
    float or array of shape (B,)
        In length/s. Samples at rest need no special case and count as they are.

    Raises
    ------
    ValueError
        If the shapes differ, or the demonstrated velocities are not finite.

    Notes
    -----
    LPV-DS (Figueroa & Billard 2018).
    """
    return _root_mean_square(as_pairs(demonstrated, predicted, quantity="velocities"))


def nll(log_probabilities: ArrayLike, dimension: int) -> float:
    r"""Mean negative log-likelihood of held-out transitions, per dimension.

    .. math:: -\frac{1}{n d} \sum_i \log p(x_{t_i + k} \mid x_{t_i})

    Parameters
    ----------
    log_probabilities
        Natural logarithms of the densities that the method gives the transitions, shape (n,).
    dimension
        d of the positions.

    Returns
    -------
    float
        In nats per dimension, for positions in the demonstrations' units. Infinity if one of the
        transitions has no density, or a log-density that is no number.

    Raises
    ------
    ValueError
        If there are no transitions, or the dimension is not positive.

    Notes
    -----
    Urain et al., "ImitationFlow", IROS 2020. The suite reports k = 1 and k = 10 samples.
    """
    values = np.asarray(log_probabilities, dtype=np.float64)
    if values.ndim != 1 or values.size == 0:
        raise ValueError(f"Expected log-probabilities of shape (n,), got {values.shape}")
    if dimension < 1:
        raise ValueError(f"Expected a dimension of at least 1, got {dimension}")
    return float(-values.mean() / dimension) if np.isfinite(values).all() else np.inf


def _root_mean_square(pairs: Pairs) -> Scores:
    with np.errstate(over="ignore"):
        squared = _squared_norm(pairs.reproduction - pairs.demonstration)
        return pairs.scores(np.sqrt(squared.mean(axis=-1)))


def _squared_norm(vectors: FloatArray) -> FloatArray:
    result: FloatArray = np.einsum("...i,...i->...", vectors, vectors)
    return result


def _unit(vectors: FloatArray) -> FloatArray:
    """Vectors of length one in the same directions, shape (..., d); zero where the vector is zero.

    Dividing by the largest component first keeps tiny and huge vectors from under- and overflowing.
    """
    largest = np.abs(vectors).max(axis=-1, keepdims=True)
    scaled = vectors / np.where(largest > 0, largest, 1.0)
    length = np.sqrt(_squared_norm(scaled))[..., None]
    return scaled / np.where(length > 0, length, 1.0)


def _one_minus_cosine(v: FloatArray, v_hat: FloatArray) -> FloatArray:
    """1 - cos of the angle between v and v_hat, shape (..., d) -> (...), in [0, 2].

    For unit vectors 1 - cos = ‖u - w‖² / 2, which keeps its digits for small angles and is never
    negative. Zero velocities are settled as ``direction_error`` says.
    """
    error = np.minimum(0.5 * _squared_norm(_unit(v) - _unit(v_hat)), 2.0)
    error = np.where((v_hat == 0).all(axis=-1), 1.0, error)
    return np.where((v == 0).all(axis=-1), 0.0, error)


def _cross(a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    """Twice the signed area of the triangles abc in the plane, shape (..., 2) -> (...)."""
    ab, ac = b - a, c - a
    return ab[..., 0] * ac[..., 1] - ab[..., 1] * ac[..., 0]


def _tetragon_area(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> FloatArray:
    """Unsigned area of the tetragons abcd, each vertex of shape (..., 2).

    At most one pair of opposite sides crosses: ab with cd, or bc with da, the first turned by one
    vertex. Without a crossing the shoelace formula holds, convex or not. The two agree where a
    vertex touches the opposite side, so that rounding of the test there does no harm.
    """
    abc, abd = _cross(a, b, c), _cross(a, b, d)
    acd, bcd = _cross(a, c, d), _cross(b, c, d)
    area = 0.5 * np.abs(abc + acd)
    # ab crosses cd: c and d on different sides of ab, and a and b on different sides of cd.
    area = np.where(_apart(abc, abd) & _apart(acd, bcd), _crossed_area(abd, abc, acd, bcd), area)
    # bc crosses da: b and c on different sides of da, and d and a on different sides of bc.
    return np.where(_apart(abc, bcd) & _apart(abd, acd), _crossed_area(abc, bcd, abd, acd), area)


def _apart(p: FloatArray, q: FloatArray) -> BoolArray:
    """Whether two numbers have strictly opposite signs."""
    result: BoolArray = np.sign(p) * np.sign(q) < 0
    return result


def _crossed_area(pqs: FloatArray, pqr: FloatArray, prs: FloatArray, qrs: FloatArray) -> FloatArray:
    """Area of the triangles that the sides pq and rs form, crossing at x: pxs and xqr.

    The arguments are twice the signed areas of the triangles. x lies at the fraction
    |prs| / (|prs| + |qrs|) of pq, because the distances of p and q from the line rs are as their
    triangles; the triangles pxs and xqr are that fraction of pqs and the rest of pqr.
    """
    total = np.abs(prs) + np.abs(qrs)
    fraction = np.abs(prs) / np.where(total > 0, total, 1.0)
    return 0.5 * (fraction * np.abs(pqs) + (1.0 - fraction) * np.abs(pqr))


def _triangle_area(a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    """Area of triangles in space, each vertex of shape (..., 3)."""
    return 0.5 * np.sqrt(_squared_norm(np.cross(b - a, c - a)))


def _sweep(pairs: Pairs, accumulate: np.ufunc, *, root: bool) -> FloatArray:
    """Run c_ij = accumulate(distance_ij, min(c_{i-1,j}, c_{i,j-1}, c_{i-1,j-1})) to the last cell.

    All cells of an anti-diagonal i + j = k depend only on the two diagonals before it, so that a
    diagonal of all pairs is one vector operation. Indexed by i, a diagonal pairs x[i] with
    y[k - i]: with y reversed both are contiguous, and the next diagonal is the same window of y
    moved by one sample. Distances are made for a block of diagonals at a time; y is padded with
    infinity, so that cells outside the matrix are infinite by themselves.

    Arrays are flat with the pair as the fast index (sample i of pair b at i B + b), so that one
    pair and many run through the same one-dimensional code.

    Parameters
    ----------
    pairs
        Sequences of shape (B, T, d) and (B, S, d).
    accumulate
        ``np.maximum`` (Fréchet) or ``np.add`` (DTW).
    root
        Whether distances are Euclidean, rather than squared.

    Returns
    -------
    array of shape (B,)
        c at (T-1, S-1).
    """
    n_pairs, n_x, d = pairs.demonstration.shape
    n_y = pairs.reproduction.shape[1]
    n_diagonals = n_x + n_y - 1
    x = np.ascontiguousarray(pairs.demonstration.transpose(2, 1, 0)).reshape(d, -1)
    y = np.full((d, n_x + n_y + n_x, n_pairs), np.inf)
    y[:, n_x : n_x + n_y] = pairs.reproduction.transpose(2, 1, 0)[:, ::-1]
    y = y.reshape(d, -1)
    item = y.itemsize

    # Three rolling diagonals; index i + 1 holds sample i of x, and index 0 stays infinite.
    cost = [np.full((n_x + 1) * n_pairs, np.inf) for _ in range(3)]
    block = max(1, min(_MAX_DIAGONALS, _BLOCK // (min(n_x, n_y) * n_pairs)))
    with np.errstate(over="ignore"):
        first = _squared_norm(pairs.demonstration[:, 0] - pairs.reproduction[:, 0])
        cost[0][n_pairs : 2 * n_pairs] = np.sqrt(first) if root else first
        for start in range(1, n_diagonals, block):
            stop = min(start + block, n_diagonals)
            low, high = max(0, start - n_y + 1) * n_pairs, min(n_x, stop) * n_pairs
            window_start = (n_x + n_y - 1 - start) * n_pairs + low
            distance = np.zeros((stop - start, high - low))
            for x_k, y_k in zip(x, y, strict=True):
                windows: FloatArray = np.ndarray(
                    distance.shape, y.dtype, y_k, window_start * item, (-n_pairs * item, item)
                )
                difference = x_k[low:high] - windows
                distance += np.square(difference, out=difference)
            if root:
                np.sqrt(distance, out=distance)
            before = [c[low:high] for c in cost]  # at x's sample before
            here = [c[low + n_pairs : high + n_pairs] for c in cost]
            for k, row in zip(range(start, stop), distance, strict=True):
                new, last = here[k % 3], (k - 1) % 3
                np.minimum(before[last], here[last], out=new)
                np.minimum(new, before[(k - 2) % 3], out=new)
                accumulate(new, row, out=new)
    last_cell: FloatArray = cost[(n_diagonals - 1) % 3][n_x * n_pairs :]
    return last_cell
