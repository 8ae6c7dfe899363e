"""The whole clean-up, the kind of motion, and the file that comes of it."""

import contextlib
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iflow_gym.datasets.lasa import SINGLE_MOTIONS, load_lasa
from iflow_gym.datasets.letters import LETTERS, load_letter
from iflow_gym.demonstration_files import (
    SCHEMA_VERSION,
    DemonstrationFileError,
    demonstrations_as_bytes,
    demonstrations_from_bytes,
    load_demonstrations,
    read_demonstration_file,
    save_demonstrations,
)
from iflow_gym.recordings import CleanUp, RawRecording, RecordingError, clean
from iflow_gym.recordings.kinds import cut_to_rounds, decide
from iflow_gym.recordings.picture import cleaning_figure


def raw(demonstrations, every=1):
    return [
        RawRecording(f"{demonstrations.name} {i}", demonstrations.times(i)[::every], p[::every])
        for i, p in enumerate(demonstrations.positions)
    ]


def circle(rounds, decay=0.0, drift=0.0, n=None, name="c"):
    t = np.linspace(0, rounds, round(80 * rounds) if n is None else n)
    radius = np.exp(-decay * t)[:, None]
    path = radius * np.stack([np.cos(2 * np.pi * t), np.sin(2 * np.pi * t)], axis=1)
    return RawRecording(name, t, path + drift * t[:, None] * [1.0, 0.0])


# The kind of motion -------------------------------------------------------------------------


@pytest.mark.parametrize("shape", SINGLE_MOTIONS)
def test_handwriting_ends(shape):
    assert decide(raw(load_lasa(shape).subset([0, 1]), every=10)).kind == "goal"


@pytest.mark.parametrize("letter", LETTERS)
def test_letters_repeat_with_their_period(letter):
    motion = load_letter(letter).subset([0, 1])
    found = decide(raw(motion))
    assert found.kind == "cycle"
    assert np.mean(found.periods) == pytest.approx(motion.period, rel=0.15)


def test_what_cannot_be_told_is_asked():
    with pytest.raises(RecordingError, match=r"goes round once.*--kind goal or --kind cycle"):
        decide([circle(1.0)])
    with pytest.raises(RecordingError, match=r"1\.\d times"):
        decide([circle(1.5)])
    with pytest.raises(RecordingError, match="1 of 2 that come back"):
        decide([circle(3.0), raw(load_lasa("Angle"), every=10)[0]])
    with pytest.raises(RecordingError, match="changes its size"):
        decide([circle(3.0, decay=0.3)])


def test_who_says_what_it_is_is_believed_where_that_can_be():
    assert decide([circle(3.0)], "goal").kind == "goal"
    assert decide([circle(1.5)], "cycle").kind == "cycle"
    with pytest.raises(RecordingError, match="whose round was not found"):
        decide(raw(load_lasa("Line"), every=10), "cycle")


def test_rounds_are_cut_to_whole_ones():
    kept, note = cut_to_rounds(circle(3.4), 1.0)
    np.testing.assert_allclose(kept.positions[-1], kept.positions[0], atol=0.1)
    assert kept.times[-1] == pytest.approx(3.0, abs=0.03)
    assert note.values["kept"] == 3
    whole, note = cut_to_rounds(circle(1.6), 1.0)
    assert len(whole) == len(circle(1.6))
    assert "all kept" in note.text


# The whole ----------------------------------------------------------------------------------


def test_clean_data_come_through_bit_for_bit():
    motion = load_lasa("Sharpc").subset([0, 1])
    even = [
        np.linspace(0, d, len(p)) for d, p in zip(motion.durations, motion.positions, strict=True)
    ]
    recordings = [
        RawRecording(str(i), even[i], p, v)
        for i, (p, v) in enumerate(zip(motion.positions, motion.velocities, strict=True))
    ]
    cleaned = clean(recordings, CleanUp(unit="mm", trim=False, goal=(0.0, 0.0)))
    for kind in ("positions", "velocities"):
        for mine, theirs in zip(
            getattr(cleaned.demonstrations, kind), getattr(motion, kind), strict=True
        ):
            np.testing.assert_array_equal(mine, theirs)
    assert [n.step for n in cleaned.notes] == ["kind"]


def test_everything_that_is_done_is_noted():
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.uniform(0.004, 0.02, 250))
    s = np.clip((times - 0.5) / 1.5, 0, 1)
    s = (s**3 * (10 - 15 * s + 6 * s**2))[:, None]
    path = 100 * ((1 - s) * [1.0, 0.0] + s * [0.0, 0.5]) + rng.normal(0, 0.2, (250, 2))
    path[120] = np.nan
    times[60] = times[59]
    recordings = [
        RawRecording("a", times, path),
        RawRecording("b", times, path + np.array([3.0, 0.0])),
    ]
    options = CleanUp(unit="mm", to_unit="m", bad_times="drop", align="shift", name="stroke")
    cleaned = clean(recordings, options)
    steps = [n.step for n in cleaned.notes if n.recording in ("", "a")]
    assert steps == ["units", "times", "missing", "trim", "resample", "smooth", "kind", "align"]
    texts = {n.step: n.text for n in cleaned.notes if n.recording == "a"}
    assert re.search(r"by [\d.e-]+ m RMS and .* m at most; .* by [\d.e-]+ m$", texts["smooth"])
    assert re.fullmatch(r"shifted by [\d.]+ m to end at the goal", texts["align"])
    motion = cleaned.demonstrations
    assert motion.length_unit == "m"
    np.testing.assert_allclose(motion.goal, [0.0015, 0.05], atol=2e-3)
    assert motion.peak_speed == pytest.approx(np.hypot(0.1, 0.05) * 1.875 / 1.5, rel=0.1)
    assert {"step", "recording", "text"} <= set(cleaned.report()[0])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"goal": (1.0,)}, "goal of 2 numbers"),
        ({"unit": "px", "to_unit": "m"}, "unit of length to convert"),
        ({"period": 1.0, "kind": "goal"}, "drop one"),
        ({"kind": "cycle", "align": "shift"}, "to have no goal"),
        ({"still": 2.0}, "still from 0 to below 1"),
        ({"hold_out": 7}, "--hold-out"),
        ({"goal": (9.0, 9.0)}, r"within [\d.]+ mm of one goal.* mm away.*--align shift"),
        ({"still": 0.9}, r"\d\d% of its diagonal: count less as still"),
        ({"period": -1.0}, "period > 0"),
    ],
)
def test_options_that_do_not_fit_say_what_to_do(options, message):
    recordings = (
        [circle(3.0)] if options.get("kind") == "cycle" else raw(load_lasa("Line"), every=10)
    )
    with pytest.raises(RecordingError, match=message):
        clean(recordings, CleanUp(**{"unit": "mm", **options}))


def test_uneven_samples_are_refused_where_resampling_is_left_out():
    times = np.cumsum(np.random.default_rng(0).uniform(0.1, 0.3, 50))
    recording = RawRecording("a", times, np.stack([times, times**2], axis=1))
    with pytest.raises(RecordingError, match="resample them"):
        clean([recording], CleanUp(resample=False, trim=False))


def test_a_cycle_of_ones_own_is_scored_as_one():
    motion = clean([circle(4.3), circle(5.2)], CleanUp(name="ring")).demonstrations
    assert motion.period == pytest.approx(1.0, abs=0.02)
    assert motion.goal is None
    assert [round((len(p) - 1) * h) for p, h in zip(motion.positions, motion.dt, strict=True)] == [
        4,
        5,
    ]


def test_strokes_in_one_recording_are_split_into_demonstrations():
    stroke = raw(load_lasa("Angle"), every=10)[0]
    times = np.concatenate([stroke.times + i * (stroke.times[-1] + 3.0) for i in range(3)])
    one = RawRecording("one", times, np.tile(stroke.positions, (3, 1)))
    with pytest.raises(RecordingError, match="--split 1"):
        clean([one], CleanUp())
    cleaned = clean([one], CleanUp(split=1.0))
    assert len(cleaned.demonstrations) == len(cleaned.before) == 3
    assert cleaned.demonstrations.goal is not None
    assert [r.times[0] for r in cleaned.before] == [0.0, 0.0, 0.0]
    assert len(clean([one], CleanUp(split=9.0, kind="cycle", cut=False)).demonstrations) == 1


@pytest.mark.parametrize("tall", [0.1, 0.5, 1.0])
def test_the_picture_of_a_flat_motion_has_no_white_bands(tall):
    s = np.linspace(0, 1, 60)[:, None]
    path = (1 - s) * [1.0, 0.0] + np.sin(np.pi * s) * [0.0, tall]
    cleaned = clean([RawRecording("a", s[:, 0], path)], CleanUp(kind="goal", trim=False))
    figure = cleaning_figure(cleaned)
    figure.draw_without_rendering()
    drawn = figure.axes[0].get_position()
    room = figure.axes[0].get_position(original=True)
    inches = figure.get_size_inches()[1]
    assert (room.height - drawn.height) * inches < 0.8
    assert inches <= 6.6


# The file -----------------------------------------------------------------------------------


def same(one, other):
    assert one.sha256 == other.sha256
    for name in ("name", "length_unit", "source", "held_out", "period", "dt"):
        assert getattr(one, name) == getattr(other, name)


@pytest.mark.parametrize("motion", [load_lasa("Angle"), load_letter("S")], ids=["goal", "cycle"])
def test_a_file_round_trips_bit_for_bit(motion, tmp_path):
    path = save_demonstrations(motion, tmp_path / "m.safetensors", history=["trimmed"])
    same(load_demonstrations(path), motion)
    assert read_demonstration_file(path).history == ("trimmed",)
    assert list(tmp_path.iterdir()) == [path]


SMALL = demonstrations_as_bytes(
    clean([circle(3.0, n=40)], CleanUp(smooth=0.0, trim=False, cut=False)).demonstrations
)


def test_later_versions_and_foreign_files_say_what_to_do(tmp_path):
    assert SCHEMA_VERSION == 1
    with pytest.raises(DemonstrationFileError, match="upgrade iflow-gym"):
        demonstrations_from_bytes(
            SMALL.replace(b'schema_version\\": 1', b'schema_version\\": 9'), "it"
        )
    for content in (b"", b"not a file", b"\xff" * 100, b"PK\x03\x04" + bytes(100)):
        with pytest.raises(DemonstrationFileError, match="iflow-gym import"):
            demonstrations_from_bytes(content, "it")
    with pytest.raises(FileNotFoundError):
        load_demonstrations(tmp_path / "absent")


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_a_damaged_file_is_told_and_never_read_as_another_motion(data):
    whole = demonstrations_from_bytes(SMALL, "it").demonstrations
    content = bytearray(SMALL)
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(content) - 1))
        content[at] = data.draw(st.integers(0, 255))
    if data.draw(st.booleans()):
        del content[data.draw(st.integers(0, len(content) - 1)) :]
    with contextlib.suppress(DemonstrationFileError):  # anything else is a failure
        read = demonstrations_from_bytes(bytes(content), "it").demonstrations
        assert read.sha256 == whole.sha256  # only words can have changed
