"""Rounds of cycles whose rounds are known."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from iflow_gym.datasets.letters import DT, LETTERS, MARGIN, recordings
from iflow_gym.rounds import period_of, phases, round_starts, turning

TIME = np.arange(0, 10, 0.01)
EVEN = 0.9 * TIME
DRIFTING = TIME + 0.25 * 7 / (2 * np.pi) * (1 - np.cos(2 * np.pi * TIME / 7))
"""Rounds run through, at a tempo that goes from 0.75 to 1.25 a second and back."""


def wave(rounds, times=1):
    return np.cos(2 * np.pi * times * rounds), np.sin(2 * np.pi * times * rounds)


def circle(rounds):
    return np.column_stack(wave(rounds))


def ellipse(rounds):
    return circle(rounds) * [1.0, 0.2]


def two_strokes(rounds):
    """A high arch one way and a lower one back, with a sharp turn at either end."""
    u = (2 * rounds) % 2
    x = np.where(u < 1, np.cos(np.pi * u), np.cos(np.pi * (2 - u)))
    height = np.where(u < 1, 0.5, 0.25)
    return np.column_stack([x, height * (1 - x**2)])


def retraced(rounds):
    """There and back along one arch: position alone returns twice a round."""
    x = np.cos(2 * np.pi * rounds)
    return np.column_stack([x, 0.4 * (1 - x**2)])


def line(rounds):
    return np.cos(2 * np.pi * rounds)[:, None]


def eight(rounds):
    return np.column_stack([wave(rounds)[1], wave(rounds, 2)[1]])


def two_loops(rounds):
    """A small loop within a large one: each nearly a round by itself."""
    return circle(2 * rounds) * (1 + 0.35 * np.cos(2 * np.pi * rounds))[:, None]


def wound(rounds):
    """On a torus in three dimensions."""
    (c, s), (c3, s3) = wave(rounds), wave(rounds, 3)
    return np.column_stack([(1 + 0.3 * c3) * c, (1 + 0.3 * c3) * s, 0.3 * s3])


FIGURES = (circle, ellipse, two_strokes, retraced, line, eight, two_loops, wound)


@pytest.mark.parametrize("rounds", [EVEN, DRIFTING], ids=["even", "drifting"])
@pytest.mark.parametrize("figure", FIGURES, ids=lambda f: f.__name__)
def test_phases_are_those_run_through_whatever_the_tempo(figure, rounds):
    path = figure(rounds)
    true = rounds - rounds[0]
    found = phases(path, 0.01)
    assert found[0] == 0
    assert (np.diff(found) >= 0).all()
    # The same but for how phase runs within a round: whole rounds apart stay whole rounds apart.
    later = np.interp(true + 1, true, found)
    inner = true < true[-1] - 1
    assert np.abs(later - found - 1)[inner].max() < 0.035
    starts = round_starts(path, 0.01)
    expected = np.interp(np.arange(np.floor(true[-1]) + 1), true, np.arange(len(true)))
    assert len(starts) == len(expected)
    assert np.abs(starts - expected).max() <= 4
    durations = np.interp(true[inner] + 1, true, TIME) - TIME[inner]
    assert period_of(path, 0.01) == pytest.approx(durations.mean(), rel=0.01)


@pytest.mark.parametrize("begin", [0, 17, 55, 120, 333])
def test_a_recording_may_begin_anywhere_and_end_anywhere(begin):
    for figure in (ellipse, two_strokes):
        path, true = figure(DRIFTING)[begin : begin + 600], DRIFTING[begin : begin + 600]
        starts = round_starts(path, 0.01)
        np.testing.assert_allclose(np.diff(true[starts]), 1, atol=0.04)
        assert true[-1] - true[starts[-1]] < 1.02


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("noise", [0.02, 0.06])
def test_noise_hides_no_round(noise, seed):
    path = circle(DRIFTING) * [1.0, 0.3]
    path = path + np.random.default_rng(seed).normal(scale=noise, size=path.shape)
    starts = round_starts(path, 0.01)
    assert len(starts) == int(DRIFTING[-1]) + 1
    np.testing.assert_allclose(np.diff(DRIFTING[starts]), 1, atol=0.1)


def test_the_sample_time_scales_the_period_alone():
    path = ellipse(DRIFTING)
    assert period_of(path, 3.0) == pytest.approx(300 * period_of(path, 0.01), rel=1e-12)
    np.testing.assert_array_equal(round_starts(path, 3.0), round_starts(path, 0.01))


def test_place_size_and_turn_of_the_path_change_nothing():
    path = two_loops(EVEN)
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    np.testing.assert_allclose(phases(1e-3 * path @ turn + 7, 0.01), phases(path, 0.01), atol=0.006)


@pytest.mark.parametrize("per_round", [12, 20, 100, 2500])
def test_any_number_of_samples_a_round(per_round):
    n_rounds = 3.4 if per_round > 1000 else 7.4
    n = int(n_rounds * per_round)
    assert period_of(circle(np.arange(n) / per_round), 1.0) == pytest.approx(per_round, rel=0.01)


def test_many_rounds():
    path = circle(np.arange(0, 150, 0.05))
    np.testing.assert_allclose(round_starts(path, 0.05), 20 * np.arange(150), atol=1)


def test_less_than_two_rounds_suffice():
    assert period_of(two_strokes(EVEN)[:160], 0.01) == pytest.approx(1 / 0.9, rel=0.02)


def test_a_period_that_is_given_decides():
    """Of two loops the small difference may be meant, or not."""
    path = two_loops(TIME)  # a round a second; half a round is nearly one
    assert len(round_starts(path, 0.01, period=1.0)) == 10
    assert len(round_starts(path, 0.01, period=0.5)) >= 19
    assert len(round_starts(circle(TIME), 0.01, period=2.0)) == 5


@pytest.mark.parametrize(
    "path",
    [
        np.column_stack([TIME, TIME]),
        np.column_stack([TIME, np.sin(TIME)]),
        circle(EVEN)[:80],
        np.cumsum(np.random.default_rng(0).normal(size=(500, 2)), axis=0),
        np.column_stack([TIME, TIME]) + np.random.default_rng(0).normal(scale=0.1, size=(1000, 2)),
    ],
    ids=["line", "sine", "part of a round", "random walk", "noisy line"],
)  # fmt: skip
def test_what_never_returns_has_no_rounds(path):
    with pytest.raises(ValueError, match="returns to where it was"):
        period_of(path, 0.01)


@pytest.mark.parametrize(
    ("path", "dt", "period", "message"),
    [
        (np.zeros(50), 0.01, None, r"got shape \(50,\)"),
        (np.full((50, 2), np.nan), 0.01, None, "NaN"),
        (np.ones((50, 2)), 0.01, None, "50 samples alike"),
        (circle(EVEN)[:5], 0.01, None, "5 samples, too few"),
        (circle(EVEN), 0.0, None, "dt > 0"),
        (circle(EVEN), 0.01, 9.0, "a period between 8 samples"),
        (circle(EVEN), 0.01, 0.02, r"got 0\.02 s"),
    ],
)
def test_errors_say_what_came(path, dt, period, message):
    with pytest.raises(ValueError, match=message):
        round_starts(path, dt, period)


def test_turning_of_closed_curves():
    assert turning(circle(np.linspace(0, 1.01, 102))) == pytest.approx(1, abs=0.02)
    assert turning(circle(np.linspace(2, 0, 201))) == pytest.approx(-2, abs=0.02)
    assert turning(eight(np.linspace(0, 1, 401))) == pytest.approx(0, abs=0.02)
    assert turning(np.column_stack([TIME, TIME])) == 0
    with pytest.raises(ValueError, match="moving path"):
        turning(np.ones((20, 2)))


@pytest.mark.parametrize("letter", LETTERS)
def test_rounds_of_letters_are_those_that_were_made(letter):
    for r in recordings(letter)[:6]:
        path, true = r.positions[MARGIN:-MARGIN], r.phases[MARGIN:-MARGIN]
        starts = round_starts(path, DT)
        assert len(starts) in (4, 5)  # the fourth round ends where the recording does
        np.testing.assert_allclose(true[starts[:4]] - true[0], np.arange(4), atol=0.08)
        for a, b in pairwise(starts):
            smooth = gaussian_filter1d(path, 1.0, axis=0)[a : b + 1]
            assert turning(smooth) == pytest.approx(1, abs=0.2)
