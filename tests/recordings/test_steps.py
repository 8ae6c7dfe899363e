"""Each step of the clean-up against motions whose true course is known."""

import numpy as np
import pytest

from iflow_gym.recordings.raw import RawRecording, RecordingError
from iflow_gym.recordings.steps import (
    aligned,
    check_gaps,
    in_order,
    resampled,
    scaled,
    scatter,
    smoothed,
    split_at_gaps,
    trimmed,
    without_gaps,
)


def least_jerk(t, begin=0.0, duration=1.0):
    s = np.clip((t - begin) / duration, 0, 1)
    return s**3 * (10 - 15 * s + 6 * s**2)


def line(times, ends=((1.0, 0.0), (0.0, 0.5)), begin=0.0, duration=1.0):
    s = least_jerk(times, begin, duration)[:, None]
    return RawRecording("a", times, (1 - s) * ends[0] + s * ends[1])


def noisy(recording, sigma, seed=0):
    rng = np.random.default_rng(seed)
    moved = recording.positions + rng.normal(0, sigma, recording.positions.shape)
    return RawRecording(recording.name, recording.times, moved)


# Times --------------------------------------------------------------------------------------


def with_times(*times):
    stamps = np.array(times, dtype=float)
    return RawRecording("a", stamps, np.arange(len(stamps) * 2.0).reshape(-1, 2))


def test_times_in_order_stay_as_they_are():
    recording = with_times(0, 1, 2, 3)
    assert in_order(recording) == (recording, None)


def test_repeated_and_backward_times_are_an_error_that_counts_them():
    recording = with_times(0, 1, 1, 2, 1.5, 3)
    with pytest.raises(RecordingError, match=r"1 repeated and 1 backward .* sample 2: 1 s after 1"):
        in_order(recording)


def test_dropping_keeps_what_is_later_than_all_before():
    kept, note = in_order(with_times(0, 1, 1, 5, 2, 3, 6), "drop")
    np.testing.assert_array_equal(kept.times, [0, 1, 5, 6])
    np.testing.assert_array_equal(kept.positions[:, 0], [0, 2, 6, 12])
    assert note.values == {"repeated": 1, "backward": 2}


def test_a_missing_time_is_no_backward_time():
    recording = with_times(0, 1, np.nan, 2)
    assert in_order(recording)[1] is None


# Missing samples ----------------------------------------------------------------------------


def with_holes():
    recording = line(np.linspace(0, 1, 21))
    positions, times = recording.positions.copy(), recording.times.copy()
    positions[[0, 5, 6]] = np.nan
    times[10] = np.nan
    positions[20, 1] = np.inf
    return RawRecording("a", times, positions), recording


def test_dropped_rows_are_those_that_lack_anything():
    holed, whole = with_holes()
    kept, note = without_gaps(holed)
    rows = [i for i in range(21) if i not in (0, 5, 6, 10, 20)]
    np.testing.assert_array_equal(kept.positions, whole.positions[rows])
    assert note.values["missing"] == 5
    assert note.values["longest_gap_seconds"] == pytest.approx(3 / 20)


def test_interpolated_rows_lie_on_the_line_between_their_neighbours():
    holed, whole = with_holes()
    filled, note = without_gaps(holed, "interpolate")
    assert note.values["interpolated"] == 2
    np.testing.assert_array_equal(filled.times, np.delete(whole.times, [0, 10, 20]))
    expected = whole.positions[4] + np.outer(
        [1 / 3, 2 / 3], whole.positions[7] - whole.positions[4]
    )
    np.testing.assert_allclose(filled.positions[4:6], expected)


def test_missing_rows_can_be_refused_and_too_many_always_are():
    holed, whole = with_holes()
    with pytest.raises(RecordingError, match=r"5 of 21 .* the first at sample 0"):
        without_gaps(holed, "error")
    nothing = RawRecording("a", whole.times, np.full_like(whole.positions, np.nan))
    with pytest.raises(RecordingError, match="At least 5 whole ones"):
        without_gaps(nothing)


# Trimming -----------------------------------------------------------------------------------


@pytest.mark.parametrize("sigma", [0.0, 0.001, 0.004])
@pytest.mark.parametrize("seed", range(4))
def test_the_still_ends_go_and_the_motion_stays(sigma, seed):
    """A motion from 0.5 to 1.5 s, whose slow beginning and end lose a tenth at most.

    A scatter of 0.004 on a way of 1.1 hides a little more.
    """
    lost = 0.1 if sigma < 0.004 else 0.15
    times = np.cumsum(np.random.default_rng(seed).uniform(0.005, 0.015, 220))
    whole = line(times, begin=0.5, duration=1.0)
    kept, note = trimmed(noisy(whole, sigma, seed))
    assert 0.5 - 0.06 <= kept.times[0] <= 0.5 + lost
    assert 1.5 - lost <= kept.times[-1] <= 1.5 + 0.06
    assert ("its scatter hides" in note.text) == (sigma > 0.001)
    assert note.values["start"] == np.searchsorted(times, kept.times[0])
    assert note.values["start"] + note.values["end"] + len(kept) == len(times)


def test_a_pause_within_the_motion_stays():
    times = np.linspace(0, 4, 401)
    s = 0.5 * (least_jerk(times, 0.5) + least_jerk(times, 2.5))
    kept, _ = trimmed(RawRecording("a", times, np.stack([s, s], axis=1)))
    assert kept.times[0] < 0.65
    assert kept.times[-1] > 3.35
    assert np.diff(kept.times).max() < 0.02


def test_a_motion_without_still_ends_stays_as_it_is():
    times = np.linspace(0, 1, 100)
    recording = RawRecording("a", times, np.stack([times, times**2], axis=1))
    assert trimmed(recording) == (recording, None)


# Resampling ---------------------------------------------------------------------------------


def test_even_samples_stay_bit_for_bit():
    recording = line(np.arange(50) * 0.02)
    assert resampled(recording) == (recording, None)


def test_uneven_samples_come_to_the_same_motion_on_an_even_grid():
    times = np.cumsum(np.random.default_rng(1).uniform(0.004, 0.02, 150))
    even, note = resampled(line(times))
    assert len(even) == 150
    assert (even.times[0], even.times[-1]) == (times[0], pytest.approx(times[-1]))
    np.testing.assert_allclose(np.diff(even.times), np.ptp(times) / 149)
    np.testing.assert_allclose(even.positions, line(even.times).positions, atol=2e-3)
    assert note.values["longest_step_seconds"] == pytest.approx(np.diff(times).max())


def test_the_interpolant_does_not_overshoot():
    times = np.cumsum(np.random.default_rng(2).uniform(0.004, 0.02, 60))
    steps = (times > times[30]).astype(float)
    even, _ = resampled(RawRecording("a", times, steps[:, None]))
    assert even.positions.min() >= 0
    assert even.positions.max() <= 1


def test_a_rate_sets_the_number_of_samples():
    even, _ = resampled(line(np.linspace(0, 1, 40)), rate=100)
    assert len(even) == 101
    with pytest.raises(RecordingError, match="rate > 0"):
        resampled(line(np.linspace(0, 1, 40)), rate=0)
    with pytest.raises(RecordingError, match="10 million"):
        resampled(line(np.linspace(0, 1, 40)), rate=1e9)


# Smoothing ----------------------------------------------------------------------------------


def test_cubics_pass_unchanged_with_their_slopes():
    times = np.arange(60) * 0.01
    path = np.stack([times**3 - times, 2 * times**2], axis=1)
    smooth, note = smoothed(RawRecording("a", times, path), window=0.15)
    np.testing.assert_allclose(smooth.positions, path, atol=1e-12)
    slopes = np.stack([3 * times**2 - 1, 4 * times], axis=1)
    np.testing.assert_allclose(smooth.velocities, slopes, atol=1e-9)
    assert note.values["window_samples"] == 15


def test_scatter_is_the_noise_and_not_the_motion():
    times = np.cumsum(np.random.default_rng(3).uniform(0.004, 0.02, 2000))
    clean = line(times, duration=times[-1])
    assert scatter(clean) < 1e-6
    assert scatter(noisy(clean, 0.003)) == pytest.approx(0.003 * np.sqrt(2), rel=0.1)


def test_many_rounds_are_smoothed_and_keep_their_shape():
    """7 % of eight rounds is half a round: as a window it would leave a dot."""
    times = np.arange(1500) * 0.01
    angle = 2 * np.pi * times / 1.9
    clean = RawRecording("stir", times, np.stack([np.cos(angle), 0.6 * np.sin(2 * angle)], axis=1))
    rough = noisy(clean, 0.005)
    smooth, note = smoothed(rough)
    assert note is not None
    assert note.values["moved_rms"] <= 1.5 * note.values["scatter"]

    def most(recording):
        return np.linalg.norm(recording.positions - clean.positions, axis=1).max()

    assert most(smooth) < most(rough)


def test_what_scatters_is_smoothed_by_itself_and_comes_closer_to_the_truth():
    times = np.arange(300) * 0.01
    clean = line(times, duration=3.0)
    rough = noisy(clean, 0.003)
    smooth, note = smoothed(rough)
    assert note is not None

    def rms(recording):
        return np.sqrt(np.mean((recording.positions - clean.positions) ** 2))

    assert rms(smooth) < 0.5 * rms(rough)
    assert smoothed(clean) == (clean, None)
    assert smoothed(rough, window=0) == (rough, None)


@pytest.mark.parametrize("window", [-1.0, np.nan, 0.02, 100.0])
def test_windows_that_are_none_are_refused(window):
    with pytest.raises(RecordingError, match="smoothing window"):
        smoothed(line(np.arange(60) * 0.01), window=window)


# Goals and units ----------------------------------------------------------------------------


def test_shifted_recordings_keep_their_shape_and_bent_ones_their_starts():
    times = np.linspace(0, 1, 50)
    two = [line(times), line(times, ends=((1.0, 0.0), (0.1, 0.5)))]
    shifted, notes = aligned(two, "shift")
    np.testing.assert_allclose([r.positions[-1] for r in shifted], [[0.05, 0.5]] * 2)
    np.testing.assert_allclose(
        np.diff(shifted[0].positions[:-1], axis=0),
        np.diff(two[0].positions[:-1], axis=0),
        atol=1e-12,
    )
    assert notes[0].values["distance"] == pytest.approx(0.05)
    bent, _ = aligned(two, "bend", np.zeros(2))
    np.testing.assert_allclose([r.positions[-1] for r in bent], np.zeros((2, 2)))
    np.testing.assert_array_equal(bent[0].positions[0], two[0].positions[0])


def test_bent_velocities_are_those_of_the_bent_path():
    times = np.linspace(0, 1, 400)
    recording = line(times)
    speeds = np.gradient(recording.positions, times, axis=0)
    given = RawRecording("a", times, recording.positions, speeds)
    (bent,), _ = aligned([given], "bend", np.array([0.2, 0.2]))
    expected = np.gradient(bent.positions, times, axis=0)
    np.testing.assert_allclose(bent.velocities[2:-2], expected[2:-2], atol=1e-3)


def test_units_scale_lengths_times_and_velocities():
    recording = RawRecording("a", np.array([2.0, 3.0, 4.0]), np.ones((3, 2)), np.ones((3, 2)))
    metric = scaled(recording, length=1e-3, time=1e-3)
    np.testing.assert_allclose(metric.times, [0, 1e-3, 2e-3])
    np.testing.assert_allclose(metric.positions, 1e-3)
    np.testing.assert_allclose(metric.velocities, 1.0)


# Gaps ---------------------------------------------------------------------------------------


def strokes(pause, n=3, step=0.01):
    """n times the same stroke of 1 s in one recording, with pauses in which nothing is recorded."""
    t = np.arange(101) * step
    times = np.concatenate([t + i * (1.0 + pause) for i in range(n)])
    return RawRecording("strokes.csv", times, np.tile(line(t).positions, (n, 1)))


def test_strokes_with_pauses_between_are_no_one_motion():
    with pytest.raises(RecordingError) as caught:
        check_gaps(strokes(3.64))
    for part in ("2 gaps, the longest of 3.64 s", "from 1 to 4.64 s", "--split 1)", "--split 4)"):
        assert part in str(caught.value)
    pieces, note = split_at_gaps(strokes(3.64), 1.0)
    assert [len(p) for p in pieces] == [101, 101, 101]
    assert [p.name for p in pieces] == [f"strokes.csv, part {i}" for i in (1, 2, 3)]
    assert (note.step, note.values["recordings"]) == ("split", 3)
    assert split_at_gaps(strokes(3.64), 4.0)[1] is None
    for seconds in (0.0, -1.0, np.nan):
        with pytest.raises(RecordingError, match="--split"):
            split_at_gaps(strokes(1.0), seconds)


def test_a_gap_is_judged_by_the_stretches_between_gaps_and_not_by_the_whole():
    """Of many strokes each pause is a small part."""
    with pytest.raises(RecordingError, match="59 gaps"):
        check_gaps(strokes(0.5, n=60))


def test_lost_samples_are_bridged():
    """Sixty of two thousand, and a second in which nothing moved."""
    fast = line(np.arange(2000) * 5e-4)
    check_gaps(fast.take(np.abs(np.arange(2000) - 1000) > 30))
    still = line(np.arange(300) * 0.01, begin=1.9)
    check_gaps(still.take(np.abs(np.arange(300) - 100) > 50))


def test_holes_between_pieces_are_gaps_and_backward_times_are_none():
    holes = strokes(0.0, n=2)
    times, path = np.arange(len(holes)) * 0.01, holes.positions.copy()
    path[90:140] = np.nan
    pieces, _ = split_at_gaps(RawRecording("a", times, path), 0.3)
    assert [int(p.whole.sum()) for p in pieces] == [90, 62]
    back = with_times(0.0, 0.1, 5.0, 0.2, 5.1, 5.2)
    assert [len(p) for p in split_at_gaps(back, 1.0)[0]] == [2, 4]
