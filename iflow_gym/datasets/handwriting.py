"""A model of a hand that traces a closed outline round and round.

- The outline is a closed cubic spline through via points, rounded over a stated length.
- Along it the hand obeys the two-thirds power law: speed falls with curvature as kappa^(-1/3)
  (Lacquaniti, Terzuolo & Viviani, "The law relating the kinematic and figural aspects of drawing
  movements", Acta Psychologica 54, 1983), between a highest and a lowest speed.
- From round to round the hand is never the same. The aim at every via point, the size, the slant,
  the place and the tempo each follow an Ornstein-Uhlenbeck process that has passed through two
  more lags: muscles smooth what the nerves command, and so the path stays smooth.
- The hand moves in pulses of 8 to 12 Hz (Vallbo & Wessberg, "Organization of motor output in slow
  finger movements in man", Journal of Physiology 469, 1993), which the speed shows, and trembles in
  the same band, which the path hardly does.

Random numbers are made of the raw integers of PCG64, which numpy keeps the same for ever; numpy
keeps no such promise for its normal numbers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from iflow_gym.demonstrations import FloatArray

N_KNOTS = 512
"""Knots of the outline's tables."""

MARGIN = 2
"""Samples made beyond either end of a recording, for central differences of fourth order."""


@dataclass(frozen=True)
class Variation:
    """How much a quantity wanders: standard deviations within and between recordings."""

    within: float
    between: float = 0.0


@dataclass(frozen=True)
class Hand:
    """How a hand moves. Lengths as a fraction of the outline's height, speeds of the mean speed."""

    rounding: float = 0.018
    """Standard deviation of the Gaussian, along the outline, that rounds its corners."""
    slow_curvature: float = 40.0
    """Curvature, times height, above which the hand slows down no further."""
    fast_curvature: float = 0.7
    """Curvature, times height, below which the hand becomes no faster."""
    lag: float = 0.25
    """Time constant of the variation, in rounds."""
    aim: Variation = Variation(0.011, 0.005)
    """Of each via point, a coordinate; neighbours on the outline are aimed at alike."""
    size: Variation = Variation(0.014, 0.01)
    """Of the logarithm of the size."""
    slant: Variation = Variation(0.012, 0.01)
    """In radians; a shear, as slant is in handwriting."""
    place: Variation = Variation(0.014, 0.01)
    """Of the outline's centre, a coordinate."""
    tempo: Variation = Variation(0.09, 0.05)
    """Of the logarithm of the rate; between recordings, of its mean."""
    pulse: float = 0.14
    """Root mean square of the rate's fluctuation in the band of tremor, of the rate."""
    tremor: float = 0.0008
    """Root mean square of what tremor adds to a coordinate."""
    tremor_frequency: float = 10.0
    """Centre of the band in Hz."""
    tremor_bandwidth: float = 4.0
    """Width of the band in Hz, at half the power."""


def power_law(curvature: FloatArray, slow: float, fast: float) -> FloatArray:
    """Return the speed, up to a factor, at a curvature: kappa^(-1/3) between two bounds.

    Well between `fast` and `slow`, two curvatures, the speed is abs(curvature)^(-1/3); below
    `fast` it tends to fast^(-1/3), the highest, above `slow` to slow^(-1/3), the lowest. It is
    smooth throughout, also where the curvature changes its sign.
    """
    square = curvature**2
    effective = (square + fast**2) / (1 + square / slow**2)
    return np.asarray(effective ** (-1 / 6))


def steadier(hand: Hand, factor: float) -> Hand:
    """Return a hand whose path varies by a factor; its tempo varies as before."""

    def scaled(amount: Variation) -> Variation:
        return Variation(factor * amount.within, factor * amount.between)

    return replace(
        hand,
        aim=scaled(hand.aim),
        size=scaled(hand.size),
        slant=scaled(hand.slant),
        place=scaled(hand.place),
    )


class Outline:
    """A closed outline, run through in rounds at the speed of the power law.

    Parameters
    ----------
    via : array, shape (J, 2)
        Via points in order; the curve passes near them and closes by itself.
    hand : Hand
        What rounds the corners and bounds the speed.
    """

    def __init__(self, via: FloatArray, hand: Hand) -> None:
        from scipy.interpolate import CubicSpline  # here: importing scipy takes most of a second

        self.via = via
        self.height = float(np.ptp(via[:, 1]))
        weights = _smooth_weights(via, hand.rounding * self.height)
        phase = _phases(weights @ via, self.height, hand)
        self._weights = CubicSpline(phase, _closed(weights), bc_type="periodic")

    def weights(self, phase: FloatArray, order: int = 0) -> FloatArray:
        """Return how much each via point counts at phases in rounds, shape (n, J); sum to 1.

        `order` gives their derivatives with respect to the phase instead.
        """
        return np.asarray(self._weights(phase % 1.0, order))

    def position(self, phase: FloatArray, order: int = 0) -> FloatArray:
        """Return the outline, or its derivative, at phases in rounds, shape (n, 2)."""
        return np.asarray(self.weights(phase, order) @ self.via)


class Recording(NamedTuple):
    """What the hand did: samples with `MARGIN` more at either end, and their phases in rounds."""

    positions: FloatArray
    phases: FloatArray


def trace(
    outline: Outline,
    hand: Hand,
    *,
    period: float,
    n_rounds: int,
    dt: float,
    tempo: float,
    seed: tuple[int, ...],
) -> Recording:
    """Trace an outline for a number of whole rounds, from anywhere on it.

    Parameters
    ----------
    period : float
        Duration of a round at the hand's usual tempo, seconds.
    n_rounds : int
        The recording ends with the first sample that completes so many rounds.
    tempo : float
        How far the recording's mean tempo is from the usual one, in standard deviations of
        `Hand.tempo` between recordings: the n rounds last n period exp(-tempo deviation).
    seed : tuple of ints
        Of the random numbers.

    Returns
    -------
    Recording
        Positions, shape (n, 2), and phases, shape (n,).
    """
    bits = np.random.PCG64(np.random.SeedSequence(seed))
    n_via = len(outline.via)
    lag = hand.lag * period / dt
    n = int(np.ceil(1.6 * n_rounds * period / dt)) + 2 * MARGIN
    place, aim, rest = np.split(
        _wander(_uniform(bits, (2 * n_via + 5, n + round(16 * lag))), lag)[:, -n:],
        [2, 2 + 2 * n_via],
    )
    constants = _uniform(bits, (2 * n_via + 5,))
    tremor = _band(
        _uniform(bits, (3, n + round(4 / (hand.tremor_bandwidth * dt)))),
        hand.tremor_frequency * dt,
        hand.tremor_bandwidth * dt,
    )[:, -n:]

    def varied(process: FloatArray, constant: FloatArray, amount: Variation) -> FloatArray:
        return np.asarray(amount.within * process + amount.between * constant[..., None])

    shift = varied(place, constants[:2], hand.place)
    aims = varied(aim, constants[2 : 2 + 2 * n_via], hand.aim).reshape(2, n_via, n)
    aims = (2 * aims + np.roll(aims, 1, axis=1) + np.roll(aims, -1, axis=1)) / np.sqrt(6)
    size, slant = (
        varied(process, constant, amount)
        for process, constant, amount in zip(
            rest[:2], constants[-3:-1], (hand.size, hand.slant), strict=True
        )
    )
    start = constants[-1] / np.sqrt(12) + 0.5
    rate = np.exp(hand.tempo.within * rest[2] + hand.pulse * tremor[2])
    passed = np.cumsum(rate[MARGIN:]) - rate[MARGIN]
    last = n_rounds * period / dt * np.exp(-hand.tempo.between * tempo)
    rate *= n_rounds / np.interp(last, np.arange(len(passed)), passed)
    phase = start + np.cumsum(rate) - rate[: MARGIN + 1].sum()  # sample MARGIN is at the start
    end = int(np.argmax(phase >= start + n_rounds)) + 1 + MARGIN
    height = outline.height
    aimed = outline.via.T[:, :, None] + height * aims
    path = np.einsum("tj,djt->dt", outline.weights(phase), aimed)
    path[0] += slant * path[1]
    path = np.exp(size) * path + height * (shift + hand.tremor * tremor[:2])
    return Recording(path.T[:end], phase[:end])


def stratified(n: int, seed: tuple[int, ...]) -> FloatArray:
    """Return uniform numbers of variance 1, one from each nth of their range, in random order.

    The standard deviation of their mean is n^(-3/2); that of independent ones would be n^(-1/2).
    """
    order, within = _uniform(np.random.PCG64(np.random.SeedSequence(seed)), (2, n))
    return np.asarray((2 * np.argsort(order) + 1 - n) * np.sqrt(3) / n + within / n)


def central_difference(positions: FloatArray, dt: float) -> FloatArray:
    """Return velocities of fourth order at the n - 4 inner samples of positions, shape (n, d)."""
    p = positions
    return np.asarray((8.0 * (p[3:-1] - p[1:-3]) - (p[4:] - p[:-4])) / (12.0 * dt))


def _smooth_weights(via: FloatArray, rounding: float) -> FloatArray:
    """Return how much each via point counts along the outline, shape (N_KNOTS, J).

    The spline's parameter is centripetal (Lee, "Choosing nodes in parametric curve
    interpolation", Computer-Aided Design 21, 1989), which makes no loops; the knots are evenly
    spaced along the curve.
    """
    from scipy.interpolate import CubicSpline

    nodes = _closed(np.cumsum(np.hypot(*(via - np.roll(via, 1, axis=0)).T) ** 0.5))
    nodes[1:] -= nodes[0]
    nodes[0] = 0.0
    nodes[-1] += np.hypot(*(via[0] - via[-1])) ** 0.5 + nodes[-2]
    spline = CubicSpline(nodes, _closed(np.eye(len(via))), bc_type="periodic")
    fine = np.linspace(0, nodes[-1], 8 * N_KNOTS + 1)
    steps = np.diff(spline(fine) @ via, axis=0)
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*steps.T))])
    even = np.interp(np.arange(N_KNOTS) / N_KNOTS * length[-1], length, fine)
    waves = np.fft.rfftfreq(N_KNOTS, 1 / N_KNOTS)
    damping = np.exp(-2 * (np.pi * waves * rounding / length[-1]) ** 2)
    spectrum = np.fft.rfft(spline(even), axis=0)
    return np.asarray(np.fft.irfft(damping[:, None] * spectrum, N_KNOTS, axis=0))


def _phases(curve: FloatArray, height: float, hand: Hand) -> FloatArray:
    """Return the phases at which the power law passes the points of a closed curve, and 1.

    Shape (n + 1,) for a curve, shape (n, 2), that is sampled evenly enough for derivatives by
    Fourier series.
    """
    from scipy.interpolate import CubicSpline

    first, second = (_derivative(curve, order) for order in (1, 2))
    stride = np.hypot(*first.T)
    curvature = (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / stride**3
    speed = power_law(curvature * height, hand.slow_curvature, hand.fast_curvature)
    grid = np.arange(len(curve) + 1) / len(curve)
    time = CubicSpline(grid, _closed(stride / speed), bc_type="periodic").antiderivative()(grid)
    return np.asarray(time / time[-1])


def _derivative(values: FloatArray, order: int) -> FloatArray:
    """Return a derivative of values that repeat, at even steps of [0, 1), shape (n, d)."""
    n = len(values)
    factor = (2j * np.pi * np.fft.rfftfreq(n, 1 / n)) ** order
    return np.asarray(np.fft.irfft(factor[:, None] * np.fft.rfft(values, axis=0), n, axis=0))


def _closed(values: FloatArray) -> FloatArray:
    """Append the first value, for what repeats."""
    return np.concatenate([values, values[:1]])


def _uniform(bits: np.random.PCG64, shape: tuple[int, ...]) -> FloatArray:
    """Return uniform numbers of mean 0 and variance 1; sums of them are soon normal."""
    raw = bits.random_raw(int(np.prod(shape))) >> np.uint64(11)
    return np.asarray((raw * 2.0**-53 - 0.5) * np.sqrt(12)).reshape(shape)


def _wander(noise: FloatArray, lag: float) -> FloatArray:
    """Pass noise through three lags of so many samples, scaled to variance 1."""
    from scipy.signal import lfilter

    poles = np.array([1.0, -np.exp(-1 / lag)])

    def lagged(samples: FloatArray) -> FloatArray:
        for _ in range(3):  # one after another: their product is ill-conditioned
            samples = lfilter([1.0], poles, samples, axis=-1)
        return samples

    return lagged(noise) / _size(lagged(_impulse(noise)))


def _band(noise: FloatArray, frequency: float, width: float) -> FloatArray:
    """Pass noise through a resonance, both in cycles a sample, scaled to variance 1."""
    from scipy.signal import lfilter

    radius = np.exp(-np.pi * width)
    poles = [1.0, -2 * radius * np.cos(2 * np.pi * frequency), radius**2]

    def resonant(samples: FloatArray) -> FloatArray:
        return np.asarray(lfilter([1.0, 0.0, -1.0], poles, samples, axis=-1))

    return resonant(noise) / _size(resonant(_impulse(noise)))


def _impulse(noise: FloatArray) -> FloatArray:
    impulse = np.zeros(noise.shape[-1])
    impulse[0] = 1.0
    return impulse


def _size(response: FloatArray) -> float:
    """Return the deviation that noise of variance 1 has after a filter, by its response."""
    return float(np.sqrt(np.sum(response**2)))
