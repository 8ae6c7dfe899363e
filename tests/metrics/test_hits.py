"""Drumming: hits from forces, scores from recordings, and how far one is from the other."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from iflow_gym.metrics import drumming as m

DT = 0.001


def pulse(n, *strokes, width=20):
    """A force signal with half-sine strokes (begin in samples, peak in N)."""
    force = np.zeros(n)
    for begin, peak in strokes:
        end = min(begin + width, n)
        force[begin:end] += peak * np.sin(np.pi * (np.arange(end - begin) + 0.5) / width)
    return force


# Hits ---------------------------------------------------------------------------------------


def test_a_stroke_is_a_hit_at_its_onset_with_its_peak():
    force = pulse(1000, (300, 20.0))
    (hit,) = m.detect_hits(force, DT)
    onset = np.flatnonzero(force >= m.FORCE_THRESHOLD)[0]
    assert hit == m.Hit(onset * DT, 0, force.max())


def test_the_threshold_is_inclusive():
    at, below = np.zeros((2, 100))
    at[50] = m.FORCE_THRESHOLD
    below[50] = np.nextafter(m.FORCE_THRESHOLD, 0)
    assert [h.time for h in m.detect_hits(at, DT)] == [0.05]
    assert m.detect_hits(below, DT) == []


@pytest.mark.parametrize(("gap", "hits"), [(99, 1), (100, 1), (101, 2), (150, 2)])
def test_a_hit_needs_a_quiet_refractory_time(gap, hits):
    """One sample above, then again `gap` samples later; the refractory time is 100 samples."""
    force = np.zeros(400)
    force[[100, 100 + gap]] = 10.0
    assert len(m.detect_hits(force, DT)) == hits


def test_a_stick_that_trembles_on_the_head_has_hit_once():
    force = np.zeros(2000)
    force[200:1500:50] = 10.0  # a bounce every 50 ms, for 1.3 s
    force[1700] = 10.0
    assert [h.time for h in m.detect_hits(force, DT)] == pytest.approx([0.2, 1.7])


def test_the_peak_counts_only_within_its_window():
    force = np.zeros(500)
    force[100], force[149], force[150] = 5.0, 7.0, 30.0
    (hit,) = m.detect_hits(force, DT)
    assert hit.force == 7.0


def test_drums_are_apart_and_hits_in_order_of_time():
    forces = np.stack([pulse(1000, (500, 9.0)), pulse(1000, (100, 8.0), (520, 7.0))], axis=1)
    hits = m.detect_hits(forces, DT)
    assert [h.drum for h in hits] == [1, 0, 1]
    assert np.all(np.diff([h.time for h in hits]) > 0)


def test_silence_and_a_force_from_the_beginning():
    assert m.detect_hits(np.zeros((100, 2)), DT) == []
    assert m.detect_hits(np.full(100, 5.0), DT) == [m.Hit(0.0, 0, 5.0)]


@given(st.lists(st.tuples(st.integers(0, 1), st.integers(0, 799), st.floats(0, 10)), max_size=40))
def test_the_running_detector_finds_what_the_recording_holds(samples):
    forces = np.zeros((800, 2))
    for drum, at, force in samples:
        forces[at : at + 5, drum] = force
    detector = m.HitDetector(2, DT)
    found = list(itertools.chain.from_iterable(detector.update(row) for row in forces.tolist()))
    assert sorted(found + detector.flush()) == m.detect_hits(forces, DT)


def test_the_running_detector_reports_when_the_peak_is_known_and_forgets():
    detector = m.HitDetector(1, DT)
    force = pulse(200, (50, 10.0))
    reports = [k for k, f in enumerate(force.tolist()) if detector.update([f])]
    (hit,) = m.detect_hits(force, DT)
    assert reports == [round(hit.time / DT) + round(m.PEAK_WINDOW / DT) - 1]
    detector.update([50.0])
    detector.reset()
    assert detector.flush() == []


@pytest.mark.parametrize(
    ("forces", "match"),
    [
        (np.zeros((2, 2, 2)), "Expected forces of shape"),
        ([0.0, np.nan], "Expected finite forces"),
    ],
)
def test_forces_are_checked(forces, match):
    with pytest.raises(ValueError, match=match):
        m.detect_hits(forces, DT)


# The score that a recording implies -----------------------------------------------------------

HEADS, RADII = [[0.0, -0.2, 0.5], [0.0, 0.2, 0.5]], [0.1, 0.1]


def bounce(times, drums, duration=4.0, dt=0.01, speed=0.2, tip_radius=0.01):
    """A tip that comes down to heads with `speed` so that its bead touches at `times`."""
    t = np.arange(round(duration / dt)) * dt
    # A metre below and back up takes 0.1 s, so that the way down is straight at the touch.
    gap = np.min([np.abs(t - 0.05 - x) for x in times], axis=0)
    z = 0.5 + tip_radius + speed * (gap - 0.05)
    nearest = np.argmin([np.abs(t - x) for x in times], axis=0)
    y = np.array([HEADS[drums[k]][1] for k in nearest])
    return np.stack([np.zeros_like(t), y, z], axis=1), dt


def test_a_score_is_when_the_bead_reaches_the_head():
    times, drums = [0.7033, 1.8091, 3.0002], [0, 1, 0]
    path, dt = bounce(times, drums)
    found, on = m.implied_score(path, dt, HEADS, RADII, tip_radius=0.01)
    np.testing.assert_allclose(found, times, atol=1e-9)  # straight between samples
    assert on.tolist() == drums


def test_beside_the_rim_or_above_the_head_there_is_no_note():
    path, dt = bounce([1.0], [0])
    beside = path + np.array([0.11, 0.0, 0.0])
    above = path + np.array([0.0, 0.0, 0.0101])
    for way in (beside, above):
        times, _ = m.implied_score(way, dt, HEADS, RADII, tip_radius=0.01)
        assert times.size == 0


def test_a_bead_that_stays_on_the_head_is_one_note():
    path = np.tile([0.0, 0.2, 0.6], (300, 1))
    path[100:250, 2] = 0.505
    times, drums = m.implied_score(path, 0.01, HEADS, RADII, tip_radius=0.01)
    assert drums.tolist() == [1]
    assert times == pytest.approx([0.99 + 0.01 * 0.09 / 0.095])


def test_positions_and_heads_are_checked():
    with pytest.raises(ValueError, match="Expected finite positions"):
        m.implied_score(np.zeros((5, 2)), 0.01, HEADS, RADII, tip_radius=0.01)
    with pytest.raises(ValueError, match="Expected heads of shape"):
        m.implied_score(np.zeros((5, 3)), 0.01, HEADS, RADII[:1], tip_radius=0.01)


# Score against hits ---------------------------------------------------------------------------

SCORE = ([1.0, 2.0, 3.0, 4.0], [0, 1, 0, 1])


def test_a_perfect_performance():
    assert m.hit_f1(*SCORE, *SCORE) == 1.0
    assert m.timing_error(*SCORE, *SCORE) == 0.0
    assert m.tempo_error(*SCORE, *SCORE) == 0.0
    assert m.missed(*SCORE, *SCORE) == m.extra(*SCORE, *SCORE) == 0


def test_by_hand():
    """One early by 20 ms, one late by 40 ms, one too late, one on the wrong drum, one more."""
    hits = ([0.98, 2.04, 3.051, 4.0, 4.5], [0, 1, 0, 0, 1])
    assert m.missed(*SCORE, *hits) == 2
    assert m.extra(*SCORE, *hits) == 3
    assert m.hit_f1(*SCORE, *hits) == pytest.approx(2 * 2 / (4 + 5))
    assert m.timing_error(*SCORE, *hits) == pytest.approx(30.0)


def test_the_tolerance_is_inclusive():
    assert m.hit_f1([1.0], [0], [1.05], [0]) == 1.0
    assert m.hit_f1([1.0], [0], [1.0501], [0]) == 0.0


def test_each_hit_is_one_note_only():
    assert m.hit_f1([1.0, 1.03], [0, 0], [1.01], [0]) == pytest.approx(2 / 3)
    pairs = m.match([1.0, 1.03], [0, 0], [1.01], [0])
    assert pairs.notes.tolist() == [0]  # the nearer one


def test_most_pairs_come_before_near_pairs():
    """Nearest first would pair 1.04 with 1.03 and leave 1.0 alone."""
    pairs = m.match([1.0, 1.04], [0, 0], [1.03, 1.08], [0, 0])
    assert pairs.missed == pairs.extra == 0


def test_nothing_played_and_nothing_asked_for():
    nothing = ([], [])
    assert m.hit_f1(*nothing, *nothing) == 1.0
    assert m.timing_error(*nothing, *nothing) == 0.0
    assert m.hit_f1(*SCORE, *nothing) == m.hit_f1(*nothing, *SCORE) == 0.0
    assert m.timing_error(*SCORE, *nothing) == np.inf
    assert m.tempo_error(*SCORE, *nothing) == np.inf


@pytest.mark.parametrize("factor", [0.5, 0.9, 1.0, 1.25])
def test_tempo_error_of_a_performance_at_another_tempo(factor):
    hits = (np.array(SCORE[0]) * factor, SCORE[1])
    assert m.tempo_error(*SCORE, *hits) == pytest.approx(abs(factor - 1))


def test_tempo_is_the_median_and_does_not_mind_one_extra_hit():
    times = np.arange(10.0)
    drums = np.zeros(10, dtype=int)
    assert m.tempo_error(times, drums, [*times, 4.5], [*drums, 0]) == 0.0
    with pytest.raises(ValueError, match="Expected a score with two notes"):
        m.tempo_error([1.0, 2.0], [0, 1], *SCORE)


@pytest.mark.parametrize(
    ("drums", "common"),
    [
        ([0, 1, 0, 1], 4),
        ([0, 0, 1, 1], 3),
        ([1, 0, 1, 0], 3),
        ([0], 1),
        ([0, 1, 1, 0, 1], 4),
        ([2], 0),
    ],
)
def test_sequence_f1_knows_only_the_order(drums, common):
    times = 10 + np.arange(len(drums)) * 0.3
    assert m.sequence_f1(*SCORE, times, drums) == pytest.approx(2 * common / (4 + len(drums)))
    shuffled = np.random.default_rng(0).permutation(len(drums))
    assert m.sequence_f1(*SCORE, times[shuffled], np.array(drums)[shuffled]) == m.sequence_f1(
        *SCORE, times, drums
    )


def test_sequence_f1_of_silence():
    assert m.sequence_f1([], [], [], []) == 1.0
    assert m.sequence_f1(*SCORE, [], []) == 0.0


def brute_force(notes, hits, tolerance):
    """The most pairs over every way of giving each note a hit or none."""
    best = 0
    options = [
        [None, *(j for j, (t, d) in enumerate(hits) if d == on and abs(t - at) <= tolerance + 1e-9)]
        for at, on in notes
    ]
    for choice in itertools.product(*options):
        taken = [j for j in choice if j is not None]
        if len(taken) == len(set(taken)):
            best = max(best, len(taken))
    return best


strokes = st.lists(
    st.tuples(st.integers(0, 30).map(lambda k: k / 50), st.integers(0, 1)), max_size=5
)


@given(strokes, strokes)
def test_matching_is_the_largest_there_is(notes, hits):
    together = (
        [t for t, _ in notes],
        [d for _, d in notes],
        [t for t, _ in hits],
        [d for _, d in hits],
    )
    pairs = m.match(*together)
    assert len(pairs.notes) == len(pairs.hits) == brute_force(notes, hits, m.TOLERANCE)
    assert len(set(pairs.notes.tolist())) == len(set(pairs.hits.tolist())) == len(pairs.notes)
    assert pairs.missed + len(pairs.notes) == len(notes)
    assert pairs.extra + len(pairs.hits) == len(hits)
    f1 = m.hit_f1(*together)
    assert 0.0 <= f1 <= 1.0
    assert f1 == m.hit_f1(*together[2:], *together[:2])  # symmetric


@given(strokes, st.floats(-3, 3), st.randoms())
def test_neither_order_nor_a_common_shift_matters(hits, shift, random):
    times, drums = np.array([t for t, _ in hits]), np.array([d for _, d in hits], dtype=int)
    order = list(range(len(hits)))
    random.shuffle(order)
    score = (np.array(SCORE[0]) / 10, np.array(SCORE[1]))
    plain = m.match(*score, times, drums)
    moved = m.match(score[0] + shift, score[1], (times + shift)[order], drums[order])
    assert (plain.missed, plain.extra) == (moved.missed, moved.extra)


def test_hits_are_checked():
    with pytest.raises(ValueError, match="of one shape"):
        m.match([1.0], [0, 1], [], [])
    with pytest.raises(ValueError, match="Expected finite hit_times"):
        m.match([1.0], [0], [np.nan], [0])
    with pytest.raises(ValueError, match="whole numbers"):
        m.match([1.0], [0.5], [1.0], [0])
    with pytest.raises(ValueError, match="tolerance"):
        m.match(*SCORE, *SCORE, tolerance=0.0)


# Tracking -------------------------------------------------------------------------------------


def test_tracking_rmse_is_in_millimetres():
    commanded = np.zeros((10, 3))
    assert m.tracking_rmse(commanded, commanded + np.array([0.003, 0.0, 0.004])) == pytest.approx(
        5.0
    )
    half = commanded.copy()
    half[:5, 0] = 0.002
    assert m.tracking_rmse(commanded, half) == pytest.approx(np.sqrt(2.0))
    assert m.tracking_rmse(commanded, np.full((10, 3), np.nan)) == np.inf
    with pytest.raises(ValueError, match="of one shape"):
        m.tracking_rmse(commanded, commanded[:5])
    with pytest.raises(ValueError, match="finite commands"):
        m.tracking_rmse(np.full((10, 3), np.nan), commanded)


ROUNDS = np.arange(6)
STEADY = (
    np.sort(np.concatenate([5.0 * ROUNDS, 5.0 * ROUNDS + 2.0])),
    np.tile([0, 1], 6),
)
"""Drum 0 every 5 s, drum 1 two fifths of a round later."""


class TestRhythm:
    def test_is_the_mean_of_scores_whatever_their_tempo_and_start(self):
        times, drums = STEADY
        scores = [(times, drums), (1.1 * times + 3.0, drums)]
        np.testing.assert_allclose(m.rhythm(scores), [0.0, 0.4], atol=1e-12)
        late = np.where(drums == 1, times + 0.5, times)
        np.testing.assert_allclose(m.rhythm([*scores, *[(late, drums)] * 2]), [0.0, 0.45])

    def test_a_steady_drummer_is_right_at_any_tempo(self):
        times, drums = STEADY
        for tempo in (0.7, 1.0, 1.4):
            assert m.rhythm_f1([0.0, 0.4], tempo * times + 9.0, drums, 5.0, 30 * tempo + 9) == 1.0

    def test_the_shift_is_the_one_that_matches_best(self):
        """Drum 1 is 80 ms late: 40 ms on either side fit into 50, and 60 ms do not."""
        times, drums = STEADY
        for late, f1 in ((0.08, 1.0), (-0.08, 1.0), (0.12, 0.5), (-0.12, 0.5)):
            played = np.where(drums == 1, times + late, times)
            found = m.rhythm_f1([0.0, 0.4], played, drums, 5.0, 30.0)
            assert found == pytest.approx(f1, abs=0.05)

    def test_what_is_uneven_missing_doubled_or_misplaced_costs(self):
        times, drums = STEADY
        assert m.rhythm_f1([0.0, 0.6], times, drums, 5.0, 30.0) == pytest.approx(0.5, abs=0.05)
        one = times[drums == 0], drums[drums == 0]
        assert m.rhythm_f1([0.0, 0.4], *one, 5.0, 30.0) == pytest.approx(2 * 6 / (6 + 12))
        doubled = np.concatenate([times, times + 0.2]), np.concatenate([drums, drums])
        assert m.rhythm_f1([0.0, 0.4], *doubled, 5.0, 30.0) < 0.7
        wild = times + np.random.default_rng(0).uniform(-0.6, 0.6, len(times))
        assert m.rhythm_f1([0.0, 0.4], wild, drums, 5.0, 30.0) < 0.6

    def test_silence_and_a_single_round_have_none(self):
        assert m.rhythm_f1([0.0, 0.4], [], [], 5.0, 30.0) == 0.0
        assert m.rhythm_f1([0.0, 0.4], [1.0, 3.0], [0, 1], 5.0, 30.0) == 0.0

    def test_who_stops_or_rattles_is_no_drummer(self):
        times, drums = STEADY
        early = times < 10
        f1 = m.rhythm_f1([0.0, 0.4], times[early], drums[early], 5.0, 30.0)
        assert f1 == pytest.approx(2 * 4 / (4 + 12))
        rattle = 0.12 * np.arange(250), np.arange(250) % 2
        assert m.rhythm_f1([0.0, 0.5], *rattle, 5.0, 30.0) == 0.0

    def test_a_score_of_one_round_has_none(self):
        with pytest.raises(ValueError, match="a shorter one has no rhythm"):
            m.rhythm([([1.0, 3.0], [0, 1])])
