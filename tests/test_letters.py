"""Letters made by a model of a hand: closed outlines, the power law, the same on every platform."""

import importlib.util
import os
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from iflow_gym.datasets import handwriting
from iflow_gym.datasets.handwriting import (
    MARGIN,
    Hand,
    Outline,
    Variation,
    central_difference,
    power_law,
    steadier,
    trace,
)
from iflow_gym.datasets.letters import (
    _PERIODS,
    DT,
    HAND,
    LETTERS,
    N_ROUNDS,
    load_letter,
    outline,
    recordings,
)
from iflow_gym.rounds import period_of, turning

ROOT = Path(__file__).parents[1]

SHA256 = {
    "I": "7490922d813df8d1ca2e26f48aaa3f83a4e2fcc3a862aecae683bac0d0021ee8",
    "R": "5a37d8b5d36d20c5d33079b7244c9deb8dbb3250bc5aac51e6b737d8d310e096",
    "O": "515a1ff51d6719f3b6c7fd33207a7ccd3a23ae1d5b00103f23df2720a68b51a4",
    "S": "4fe89c7df863f73c03f5fd621a2851a6a67cfa34e2a292014cb0cdfab77ffbae",
}
"""Of version 0: other numbers are another version."""


def comparison():
    spec = importlib.util.spec_from_file_location("letters_page", ROOT / "docs" / "letters.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def crossings(path):
    """Return pairs (i, j), i < j - 1, of segments that meet, shape (k, 2); signs are exact."""
    # 0.001 mm is the unit of the positions: as integers, the orientations have no rounding.
    p = np.rint(1000 * path).astype(np.int64)
    a, b = p[:-1], p[1:]

    def side(u, v, w):
        u, v, w = (np.asarray(x) for x in (u, v, w))
        return np.sign(
            (v[..., 0] - u[..., 0]) * (w[..., 1] - u[..., 1])
            - (v[..., 1] - u[..., 1]) * (w[..., 0] - u[..., 0])
        )

    a1, b1, a2, b2 = a[:, None], b[:, None], a[None], b[None]
    boxes = (
        np.maximum(np.minimum(a1, b1), np.minimum(a2, b2))
        <= np.minimum(np.maximum(a1, b1), np.maximum(a2, b2))
    ).all(axis=-1)
    meet = (
        boxes
        & (side(a1, b1, a2) * side(a1, b1, b2) <= 0)
        & (side(a2, b2, a1) * side(a2, b2, b1) <= 0)
    )
    pairs = np.argwhere(meet)
    return pairs[pairs[:, 1] > pairs[:, 0] + 1]


def test_the_test_of_crossing_sees_what_crosses_and_what_does_not():
    t = np.linspace(0, 2 * np.pi, 60)[:-1]
    circle = 100 * np.column_stack([np.cos(t), np.sin(t)])
    eight = 100 * np.column_stack([np.sin(t + 0.5), np.sin(2 * t + 1.0)])
    assert len(crossings(circle)) == 0
    assert len(crossings(eight)) == 1
    touching = np.array([[0, 0], [10, 0], [10, 5], [5, 5], [5, 0]], dtype=float)
    assert crossings(touching).tolist() == [[0, 3]]


@pytest.mark.parametrize("letter", LETTERS)
def test_a_letter_is_twenty_recordings_the_last_ten_held_out(letter):
    motion = load_letter(letter)
    assert len(motion) == 20
    assert motion.held_out == 10
    assert set(motion.dt) == {0.01}
    assert motion.length_unit == "mm"
    assert motion.goal is None
    shown, scored = motion.split("generalisation")
    assert len(shown) == len(scored) == 10
    np.testing.assert_array_equal(shown.positions[9], motion.positions[9])
    np.testing.assert_array_equal(scored.positions[0], motion.positions[10])
    assert load_letter(letter) is motion


@pytest.mark.parametrize("letter", LETTERS)
def test_the_numbers_are_those_of_this_version(letter):
    assert load_letter(letter).sha256 == SHA256[letter]


@pytest.mark.parametrize("letter", LETTERS)
def test_no_platform_rounds_the_other_way(letter):
    """Errors of one ulp in every function add up to 4e-12 mm: nothing that is rounded is as close.

    The velocities are differences of rounded numbers, which IEEE arithmetic makes alike.
    """
    made = recordings(letter)
    samples = np.concatenate([r.positions for r in made])
    to_boundary = np.abs((1000 * samples) % 1 - 0.5) / 1000
    assert to_boundary.min() > 1e-9
    for r in made:
        last = r.phases[-1 - MARGIN] - r.phases[MARGIN] - N_ROUNDS
        assert last > 1e-9
        assert r.phases[-2 - MARGIN] - r.phases[MARGIN] - N_ROUNDS < -1e-9


@pytest.mark.parametrize("letter", LETTERS)
def test_every_recording_has_four_rounds_that_never_cross_themselves(letter):
    motion = load_letter(letter)
    starts = []
    for positions, r in zip(motion.positions, recordings(letter), strict=True):
        phase = r.phases[MARGIN:-MARGIN] - r.phases[MARGIN]
        assert phase[-2] < N_ROUNDS <= phase[-1]
        cuts = np.append(np.searchsorted(phase, np.arange(N_ROUNDS)), len(phase) - 1)
        for a, b in pairwise(cuts):
            assert len(crossings(positions[a:b])) == 0
            assert turning(positions[a : b + 1]) == pytest.approx(1, abs=0.2)
        # Wherever a round is cut: what meets is a round apart, or nearly.
        met = crossings(positions)
        assert (phase[met[:, 1]] - phase[met[:, 0]] > 0.9).all()
        starts.append(r.phases[MARGIN] % 1)
    assert max(starts) - min(starts) > 0.7  # recordings begin anywhere
    assert len({round(8 * s) for s in starts}) >= 5


@pytest.mark.parametrize("letter", LETTERS)
def test_the_period_is_the_mean_duration_of_a_round_to_fit_on(letter):
    motion = load_letter(letter)
    shown, _ = motion.split()
    assert motion.period == pytest.approx(shown.durations.mean() / N_ROUNDS, abs=DT / N_ROUNDS)
    found = np.mean([period_of(p, DT) for p in shown.positions[:4]])
    assert found == pytest.approx(shown.durations[:4].mean() / N_ROUNDS, rel=0.03)


@pytest.mark.parametrize("letter", LETTERS)
def test_velocities_are_those_of_the_positions(letter):
    """Integrated by Simpson's rule, they lead from sample to sample."""
    motion = load_letter(letter)
    for p, v in zip(motion.positions, motion.velocities, strict=True):
        travelled = (v[:-2] + 4 * v[1:-1] + v[2:]) * DT / 3
        error = np.linalg.norm(p[2:] - p[:-2] - travelled, axis=1)
        steps = np.linalg.norm(p[2:] - p[:-2], axis=1)
        assert error.max() < 0.04 * steps.max()


def test_central_differences_are_exact_for_polynomials_of_fourth_degree():
    t = np.arange(12) * 0.1
    p = np.column_stack([t**4 - 2 * t, 3 * t**3])
    expected = np.column_stack([4 * t**3 - 2, 9 * t**2])[2:-2]
    np.testing.assert_allclose(central_difference(p, 0.1), expected, rtol=0, atol=1e-12)


def test_the_power_law_is_the_power_minus_a_third_between_its_bounds():
    kappa = np.geomspace(1e-6, 1e8, 1000)
    speed = power_law(kappa, 1e4, 1.0)
    assert (np.diff(speed) <= 0).all()
    assert speed.max() == pytest.approx(1.0)
    assert speed.min() == pytest.approx(1e4 ** (-1 / 3), rel=1e-6)
    middle = (kappa > 50) & (kappa < 200)
    np.testing.assert_allclose(speed[middle], kappa[middle] ** (-1 / 3), rtol=1e-3)
    np.testing.assert_array_equal(power_law(-kappa, 1e4, 1.0), speed)


def speeds_and_curvatures(shape):
    """Return the speed, in heights a round, and curvature, over the height, along an outline."""
    phase = np.arange(4000) / 4000
    first, second = shape.position(phase, 1) / 100, shape.position(phase, 2) / 100
    speed = np.hypot(*first.T)
    curvature = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / speed**3
    return speed, curvature


@pytest.mark.parametrize("letter", LETTERS)
def test_the_outline_is_traced_by_the_power_law(letter):
    speed, curvature = speeds_and_curvatures(outline(letter))
    ratio = speed / power_law(curvature, HAND.slow_curvature, HAND.fast_curvature)
    np.testing.assert_allclose(ratio, ratio.mean(), rtol=0.01)
    bound = (HAND.slow_curvature / HAND.fast_curvature) ** (1 / 3)
    assert speed.max() / speed.min() <= bound * 1.02
    used = (curvature > 2) & (curvature < 15)
    slope = np.polyfit(np.log(curvature[used]), np.log(speed[used]), 1)[0]
    assert slope == pytest.approx(-1 / 3, abs=0.03)


@pytest.mark.parametrize("letter", LETTERS)
def test_recordings_obey_the_power_law_through_all_that_varies(letter):
    slopes = [comparison().power_law_slope(p, 100.0) for p in load_letter(letter).positions]
    assert np.mean(slopes) == pytest.approx(-1 / 3, abs=0.1)


@pytest.mark.parametrize("letter", LETTERS)
def test_an_outline_is_closed_smooth_and_simple(letter):
    shape = outline(letter)
    for order in (0, 1, 2):
        np.testing.assert_allclose(
            shape.position(np.array([0.0]), order), shape.position(np.array([1.0]), order)
        )
    path = shape.position(np.linspace(0, 1, 600))
    assert len(crossings(path[:-1])) == 0
    assert turning(path) == pytest.approx(1, abs=0.01)
    assert np.ptp(path[:, 1]) == pytest.approx(100, abs=5)
    np.testing.assert_allclose(shape.weights(np.linspace(0, 3, 50)).sum(axis=1), 1, atol=1e-12)


def test_a_circle_is_traced_evenly_and_keeps_its_radius():
    angle = 2 * np.pi * np.arange(16) / 16
    via = 50 * np.column_stack([np.cos(angle), np.sin(angle)])
    shape = Outline(via, Hand(rounding=0.0))
    phase = np.linspace(0, 1, 101)
    expected = 50 * np.column_stack([np.cos(2 * np.pi * phase), np.sin(2 * np.pi * phase)])
    np.testing.assert_allclose(shape.position(phase), expected, atol=0.05)


STILL = Hand(
    aim=Variation(0), size=Variation(0), slant=Variation(0), place=Variation(0),
    tempo=Variation(0), pulse=0, tremor=0,
)  # fmt: skip


def test_a_hand_that_varies_in_nothing_repeats_its_round():
    shape = outline("R")
    r = trace(shape, STILL, period=1.0, n_rounds=3, dt=0.01, tempo=0.0, seed=(1,))
    np.testing.assert_allclose(r.positions[:100], r.positions[100:200], atol=1e-9)
    np.testing.assert_allclose(r.positions, shape.position(r.phases), atol=1e-9)
    assert len(r.positions) in (301 + 2 * MARGIN, 302 + 2 * MARGIN)


def test_variation_is_as_large_and_tremor_as_fast_as_said():
    bits = np.random.PCG64(0)
    slow = handwriting._wander(handwriting._uniform(bits, (400, 2000)), 20.0)[:, 1000:]
    assert slow.std() == pytest.approx(1, abs=0.05)
    assert np.abs(np.mean(slow**4) / 3 - 1) < 0.15  # of uniform numbers, yet normal
    # Three lags of T: the autocorrelation is (1 + s + s^2 / 3) exp(-s), s = lag / T.
    s = 30 / 20
    correlation = np.mean(slow[:, :-30] * slow[:, 30:]) / slow.var()
    assert correlation == pytest.approx((1 + s + s**2 / 3) * np.exp(-s), abs=0.05)
    fast = handwriting._band(handwriting._uniform(bits, (200, 4000)), 0.10, 0.04)[:, 400:]
    assert fast.std() == pytest.approx(1, abs=0.05)
    power = np.mean(np.abs(np.fft.rfft(fast, axis=1)) ** 2, axis=0)
    frequency = np.fft.rfftfreq(fast.shape[1])
    assert frequency[power.argmax()] == pytest.approx(0.10, abs=0.015)
    inside = (frequency > 0.06) & (frequency < 0.14)
    assert power[inside].sum() / power.sum() > 0.6


def test_random_numbers_are_those_of_the_raw_generator():
    """The first raw integer of PCG64 with seed 0, shifted to 53 bits, written out."""
    raw = int(np.random.PCG64(0).random_raw())
    first = handwriting._uniform(np.random.PCG64(0), (1,))[0]
    assert first == pytest.approx((raw / 2**64 - 0.5) * 12**0.5, abs=1e-12)


def test_other_seeds_give_other_recordings():
    shape = outline("O")
    a, b = (
        trace(shape, HAND, period=0.8, n_rounds=1, dt=DT, tempo=0.0, seed=(0, i)).positions
        for i in (0, 1)
    )
    assert np.abs(a[:50] - b[:50]).max() > 1


@pytest.mark.parametrize(("letter", "nearest"), [("i", "I"), ("s", "S")])
def test_an_unknown_letter_gets_the_nearest(letter, nearest):
    with pytest.raises(ValueError, match=f"Unknown letter '{letter}'. Did you mean '{nearest}'"):
        load_letter(letter)
    with pytest.raises(ValueError, match=r"Unknown letter 'Q'\. Known: I, R, O, S"):
        load_letter("Q")


def recorded_data():
    named = os.environ.get("IFLOW_GYM_RECORDED")
    folder = Path(named) if named else ROOT.parent / "shared" / "data"
    return folder if (folder / "letters_recorded").is_dir() else None


@pytest.mark.skipif(recorded_data() is None, reason="no mirror of the authors' recordings")
def test_letters_vary_as_the_recorded_ones_do(monkeypatch):
    """Averaged over the letters: the recorded ones are few."""
    monkeypatch.setenv("IFLOW_GYM_RECORDED", str(recorded_data()))
    page = comparison()
    measured = page.compare()
    theirs, ours = np.array(list(measured.values())).swapaxes(0, 1)
    index = {name: i for i, name in enumerate(page.Measures._fields)}

    def ratio(name):
        return np.mean(ours[:, index[name]]) / np.mean(theirs[:, index[name]])

    for name in ("period", "tempo_within", "rounds_apart", "speed", "slow", "fast", "flutter"):
        assert 0.7 < ratio(name) < 1.35, name
    np.testing.assert_allclose(ours[:, 0], theirs[:, 0], rtol=0.25)
    for name in ("orbit_distance", "orbit_hausdorff"):  # letter by letter
        np.testing.assert_allclose(ours[:, index[name]], theirs[:, index[name]], rtol=0.15)
    assert np.abs(theirs[:, index["slope"]].mean() + 1 / 3) < 0.12
    written = (ROOT / "docs" / "letters.md").read_text()
    assert page.with_table(written, page.table(measured)) == written


@pytest.mark.parametrize("letter", LETTERS)
def test_those_to_fit_on_and_those_held_out_have_the_usual_tempo(letter):
    for part in load_letter(letter).split("generalisation"):
        assert part.durations.mean() / N_ROUNDS == pytest.approx(_PERIODS[letter], rel=0.01)
        spread = np.log(part.durations).std()
        assert spread == pytest.approx(HAND.tempo.between, rel=0.1)
        assert np.ptp(part.durations) > 0.1 * part.durations.mean()


def test_stratified_numbers_are_one_from_each_part_of_the_range():
    drawn = np.array([handwriting.stratified(10, (3, i)) for i in range(400)])
    parts = np.floor((drawn / np.sqrt(12) + 0.5) * 10)
    np.testing.assert_array_equal(np.sort(parts, axis=1), np.tile(np.arange(10), (400, 1)))
    assert drawn.std() == pytest.approx(1, abs=0.02)
    assert drawn.mean(axis=1).std() == pytest.approx(10**-1.5, rel=0.15)
    np.testing.assert_allclose(drawn.mean(axis=0), 0, atol=0.2)  # any part may come first


@pytest.mark.parametrize("tempo", [-1.5, 0.0, 1.0])
def test_a_recording_lasts_as_long_as_its_mean_tempo_says(tempo):
    r = trace(outline("O"), HAND, period=0.8, n_rounds=4, dt=DT, tempo=tempo, seed=(8,))
    expected = 4 * 0.8 * np.exp(-HAND.tempo.between * tempo)
    assert expected <= (len(r.positions) - 1 - 2 * MARGIN) * DT < expected + DT


def test_a_steadier_hand_varies_less_in_path_and_as_much_in_tempo():
    shape, moved = outline("S"), []
    still = trace(shape, STILL, period=1.0, n_rounds=2, dt=DT, tempo=0.0, seed=(5,))
    hand = replace(HAND, tempo=Variation(0), pulse=0, tremor=0)
    for factor in (0.5, 1.0):
        r = trace(
            shape, steadier(hand, factor), period=1.0, n_rounds=2, dt=DT, tempo=0.0, seed=(5,)
        )
        moved.append(np.linalg.norm(r.positions - still.positions[: len(r.positions)], axis=1))
    np.testing.assert_allclose(moved[0].mean() / moved[1].mean(), 0.5, rtol=0.02)
    assert steadier(HAND, 0.5).tempo == HAND.tempo
