"""Strokes become the demonstrations that a hand meant."""

import numpy as np
import pytest
from drawing_hands import ellipse, reach

from iflow_gym.drawing.strokes import SMOOTHING, STILL, DrawingError, drawing_of


def moved(stroke, x, y):
    return np.column_stack([stroke[:, 0], stroke[:, 1] + x, stroke[:, 2] + y])


def test_uneven_samples_become_the_curve_they_were_taken_from():
    """Constant speed on a circle: smoothing shrinks it by exp(-(w s)^2 / 2), and no more."""
    rng = np.random.default_rng(0)
    rate, radius = 3.0, 30.0
    t = np.sort(np.r_[0, rng.uniform(0, 1.5, 300), 1.5])
    circle = np.column_stack([t, radius * np.cos(rate * t), radius * np.sin(rate * t)])
    motion = drawing_of([circle], "goal").demonstrations
    path, time = motion.positions[0], motion.times(0)
    trimmed = STILL / (rate * radius)  # seconds at the beginning and the end
    assert motion.durations[0] == pytest.approx(1.5, abs=2 * trimmed + 0.05)
    inner = slice(20, -20)
    assert np.linalg.norm(path[inner], axis=1) == pytest.approx(
        radius * np.exp(-((rate * SMOOTHING) ** 2) / 2), abs=0.05
    )
    angles = np.unwrap(np.arctan2(path[inner, 1], path[inner, 0]))
    assert np.polyfit(time[inner], angles, 1)[0] == pytest.approx(rate, rel=0.01)
    assert motion.length_unit == "mm"


def test_rest_at_the_ends_is_trimmed_and_a_wait_is_cut_out():
    plain = reach()
    t, places = plain[:, 0], plain[:, 1:]
    late = np.vstack([[0.0, *places[0]], np.column_stack([t + 0.9, places]), [3.5, *places[-1]]])
    moved = drawing_of([plain], "goal").demonstrations
    rested = drawing_of([late], "goal")
    assert rested.demonstrations.durations == pytest.approx(moved.durations, abs=0.02)
    assert not any("Waits" in notice for notice in rested.notices)
    paused = np.column_stack([t + np.where(t > 0.4, 1.0, 0.0), places])
    waited = drawing_of([paused], "goal")
    assert waited.demonstrations.durations == pytest.approx(moved.durations, abs=0.05)
    assert any("1.0 s" in notice for notice in waited.notices)


def test_trembling_in_place_is_rest():
    rng = np.random.default_rng(0)
    plain = reach()
    t, places = plain[:, 0], plain[:, 1:]
    tremble = np.column_stack(
        [np.linspace(0, 0.5, 30), plain[0, 1:] + rng.uniform(-0.2, 0.2, (30, 2))]
    )
    held = np.vstack([tremble, np.column_stack([t + 0.52, places])])
    durations = [drawing_of([s], "goal").demonstrations.durations[0] for s in (held, plain)]
    assert durations[0] == pytest.approx(durations[1], abs=0.03)


def test_strokes_are_shifted_as_wholes_to_the_mean_of_their_ends():
    strokes = [reach(0), moved(reach(1), 3, 0), moved(reach(2), -3, -1)]
    alone = [drawing_of([s], "goal").demonstrations.positions[0] for s in strokes]
    together = drawing_of(strokes, "goal")
    motion = together.demonstrations
    goal = np.mean([path[-1] for path in alone], axis=0)
    assert motion.goal == pytest.approx(goal)
    for path, own in zip(motion.positions, alone, strict=True):
        assert path[-1] == pytest.approx(goal)
        assert path - path[0] == pytest.approx(own - own[0])
    assert any("shifted by up to 3." in notice for notice in together.notices)
    assert not any("shifted" in notice for notice in drawing_of([reach()] * 3, "goal").notices)


def test_rounds_have_their_period_wherever_they_begin():
    strokes = [ellipse(2.5, 0.8), ellipse(3.2, 0.8, begin=2.0)]
    motion = drawing_of(strokes, "cycle").demonstrations
    assert motion.period == pytest.approx(0.8, rel=0.02)
    assert motion.goal is None
    told = drawing_of([ellipse(3, 0.8), ellipse(3, 1.6)], "cycle").notices
    assert any("from 0.8 to 1.6 s" in notice for notice in told)


@pytest.mark.parametrize(
    ("strokes", "kind", "words"),
    [
        ([], "goal", "nothing to fit"),
        ([reach(), [[0, 0, 0], [1, np.nan, 2], [2, 3, 4]]], "goal", "stroke 2.*finite"),
        ([reach(), "scribble"], "goal", "stroke 2.*finite"),
        ([[[0, 0], [1, 1], [2, 2]]], "goal", "stroke 1.*t, x, y"),
        ([reach() * [1, 1e5, 1]], "goal", "not beyond"),
        ([[]], "goal", "Expected stroke 1"),
        ([reach() * [1, 0.02, 0.02]], "goal", "Stroke 1 is .* mm across"),
        ([reach() * [0.05, 1, 1]], "goal", "took 0.0. s.*slower"),
        ([reach(), moved(reach(), 120, 30)], "goal", "mm from the mean of the ends"),
        ([ellipse(1.0)], "cycle", "Stroke 1 does not come back"),
        ([ellipse(3.0), ellipse(1.4)], "cycle", "Stroke 2 goes round 1.[34]"),
        ([reach()], "cycle", "does not come back"),
        ([ellipse(), ellipse(way=-1)], "cycle", r"anticlockwise \(1\) and some clockwise \(2\)"),
        ([reach()], "spiral", "goal or cycle"),
    ],
)
def test_what_cannot_be_learned_is_said(strokes, kind, words):
    with pytest.raises(DrawingError, match=words):
        drawing_of(strokes, kind)


def test_time_that_stands_or_runs_back_is_passed_over():
    plain = reach()
    twice = np.insert(plain, 20, plain[19] + np.array([0, 1, 1]), axis=0)  # two samples at one time
    back = np.insert(plain, 20, plain[5], axis=0)
    for stroke in (twice, back):
        path = drawing_of([stroke], "goal").demonstrations.positions[0]
        assert path == pytest.approx(drawing_of([plain], "goal").demonstrations.positions[0])


def test_a_crossing_is_told():
    t = np.linspace(0, 1, 100)
    loop = np.column_stack([t, 60 * t - 30 + 20 * np.sin(7 * t), 25 * np.sin(3 * np.pi * t)])
    assert any("crosses" in notice for notice in drawing_of([loop], "goal").notices)
    assert not any("crosses" in n for n in drawing_of([reach(k) for k in range(3)], "goal").notices)
    a = np.linspace(0, 5 * np.pi, 300)
    eight = np.column_stack([a / 6, 30 * np.sin(a), 20 * np.sin(2 * a)])
    assert any("crosses" in notice for notice in drawing_of([eight], "cycle").notices)
    assert not any("crosses" in notice for notice in drawing_of([ellipse()], "cycle").notices)
    corners = np.array([[-30, -20], [30, -20], [0, 30]])  # sharp, and not a crossing
    turns = np.linspace(0, 9, 400)
    sides = [np.interp(turns % 3, range(4), corners[[0, 1, 2, 0], k]) for k in range(2)]
    triangle = np.column_stack([turns / 2, *sides])
    assert not any("crosses" in notice for notice in drawing_of([triangle], "cycle").notices)
