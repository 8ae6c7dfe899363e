"""Recordings out of files: one motion in every format, guesses, and files that are none."""

import contextlib
import io
import json
import zipfile
import zlib

import numpy as np
import pytest
import scipy.io
from hypothesis import given, settings
from hypothesis import strategies as st

from iflow_gym.recordings import Columns, RecordingError, read_recordings
from iflow_gym.recordings.numpy_files import MOST_BYTES
from iflow_gym.recordings.reading import Source

T = np.arange(8) * 0.1
P = np.stack([np.cos(T), T**2], axis=1)
V = np.stack([-np.sin(T), 2 * T], axis=1)
TABLE = {"t": T, "x": P[:, 0], "y": P[:, 1], "vx": V[:, 0], "vy": V[:, 1]}


def text(table, separator=",", decimal="."):
    rows = [separator.join(table)]
    for row in zip(*table.values(), strict=True):
        cells = ["" if v != v else str(v) for v in row]
        rows.append(separator.join(c.replace(".", decimal) for c in cells))
    return "\n".join(rows).encode()


def npz(**arrays):
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def mat(compressed=False, version="5", **arrays):
    stream = io.BytesIO()
    scipy.io.savemat(stream, arrays, do_compression=compressed, format=version)
    return stream.getvalue()


def lines(rows):
    return "\n".join(json.dumps(row) for row in rows).encode()


def samples(table):
    """A dict a sample; a missing number is None."""
    columns = [[None if v != v else v for v in c.tolist()] for c in table.values()]
    return [dict(zip(table, row, strict=True)) for row in zip(*columns, strict=True)]


def read(content, kind, columns=None):
    return read_recordings([Source("it", content=content)], columns, format=kind)


CELLS = np.empty((1, 2), dtype=object)
CELLS[0, 0] = CELLS[0, 1] = {"pos": P.T, "t": T[None], "vel": V.T, "who": "me"}
MATRICES = np.empty((1, 2), dtype=object)
MATRICES[0, 0] = MATRICES[0, 1] = P
HEADINGS = ["Time (s)", "pos_x", "pos_y", "vel_x", "vel_y"]
TWICE = {k: np.tile(c, 2) for k, c in TABLE.items()}
NUMBERED, WORDED = np.repeat([1, 2], 8), np.repeat(["b", "a"], 8)
VECTORS = [
    {"t": t, "position": p, "velocity": v}
    for t, p, v in zip(T.tolist(), P.tolist(), V.tolist(), strict=True)
]
WHOLE = {"times": T.tolist(), "positions": P.tolist(), "velocities": V.tolist()}

SAME = {
    "csv": ("csv", text(TABLE)),
    "tabs": ("csv", text(TABLE, "\t")),
    "semicolons and decimal commas": ("csv", text(TABLE, ";", ",")),
    "spaces": ("csv", b"# by hand\n" + text(TABLE, " ")),
    "a byte order mark": ("csv", b"\xef\xbb\xbf" + text(TABLE)),
    "other names": ("csv", text(dict(zip(HEADINGS, TABLE.values(), strict=True)))),
    "milliseconds": ("csv", text({**TABLE, "t": T * 1e3}).replace(b"t,", b"t (ms),", 1)),
    "npz": ("npz", npz(times=T, positions=P, velocities=V)),
    "npz of columns": ("npz", npz(**TABLE)),
    "npz with dt": ("npz", npz(dt=0.1, positions=P, velocities=V)),
    "npz by numbers": ("npz", npz(times_0=T, positions_0=P, velocities_0=V)),
    "npz turned": ("npz", npz(t=T, pos=P.T, vel=V.T)),
    "mat": ("mat", mat(t=T, pos=P, vel=V)),
    "compressed mat": ("mat", mat(True, t=T, pos=P.T, vel=V.T)),
    "mat of version 4": ("mat", mat(version="4", t=T, pos=P, vel=V)),
    "cells of structures": ("mat", mat(demos=CELLS[:, :1])),
    "a structure": ("mat", mat(demo=CELLS[0, 0])),
    "mat of columns": ("mat", mat(**TABLE)),
    "json lines": ("jsonl", lines(samples(TABLE))),
    "vectors a line": ("jsonl", lines(VECTORS)),
    "a recording a line": ("jsonl", lines([WHOLE])),
    "a JSON list": ("jsonl", json.dumps(VECTORS).encode()),
}


@pytest.mark.parametrize(("kind", "content"), SAME.values(), ids=SAME.keys())
def test_one_motion_out_of_every_format(kind, content):
    (recording,) = read(content, kind).recordings
    np.testing.assert_allclose(recording.times - recording.times[0], T, atol=1e-12)
    np.testing.assert_allclose(recording.positions, P, atol=1e-12)
    np.testing.assert_allclose(recording.velocities, V, atol=1e-12)


def test_npy_is_positions():
    stream = io.BytesIO()
    np.save(stream, P)
    (recording,) = read(stream.getvalue(), "npz", Columns(dt=0.1)).recordings
    np.testing.assert_array_equal(recording.positions, P)
    np.testing.assert_allclose(recording.times, T)


SEVERAL = {
    "a column of numbers": ("csv", text(TWICE | {"demo": NUMBERED})),
    "a column of words": ("csv", text(TWICE | {"trial": WORDED})),
    "a stack": ("npz", npz(times=T, positions=np.stack([P, P]))),
    "arrays by numbers": ("npz", npz(t=T, positions_0=P, positions_1=P)),
    "structures": ("mat", mat(demos=CELLS)),
    "matrices in cells": ("mat", mat(demos=MATRICES)),
    "lines": ("jsonl", lines([{"times": T.tolist(), "positions": P.tolist()}] * 2)),
}


@pytest.mark.parametrize(("kind", "content"), SEVERAL.values(), ids=SEVERAL.keys())
def test_several_recordings_in_one_file(kind, content):
    columns = Columns(dt=0.1) if b"who" not in content and kind == "mat" else None
    recordings = read(content, kind, columns).recordings
    assert len(recordings) == 2
    assert len({r.name for r in recordings}) == 2
    for recording in recordings:
        np.testing.assert_allclose(recording.positions, P, atol=1e-12)


def test_several_files_are_several_recordings(tmp_path):
    for name in ("a.csv", "b.tsv"):
        (tmp_path / name).write_bytes(text(TABLE, "\t" if name == "b.tsv" else ","))
    assert len(read_recordings([tmp_path / "a.csv", tmp_path / "b.tsv"]).recordings) == 2


def test_recordings_of_one_file_stay_in_the_files_order():
    content = SEVERAL["a column of words"][1]
    assert [r.name[-1] for r in read(content, "csv").recordings] == ["b", "a"]


def test_missing_cells_are_nan_in_every_format():
    holed = {**TABLE, "x": np.where(np.arange(8) == 3, np.nan, P[:, 0])}
    words = text(holed)
    assert b",," in words
    for content, kind in ((words, "csv"), (lines(samples(holed)), "jsonl"), (npz(**holed), "npz")):
        (recording,) = read(content, kind).recordings
        np.testing.assert_array_equal(~recording.whole, np.arange(8) == 3)


def test_what_was_taken_for_what_is_said():
    reading = read(text({**TABLE, "pressure": T}), "csv")
    assert reading.notes[0].values == {
        "time": "t",
        "positions": ["x", "y"],
        "velocities": ["vx", "vy"],
        "group": None,
        "left_out": ["pressure"],
    }
    (recording,) = read(
        text(TABLE).replace(b",x,y,", b",x (mm),y (mm),"), "csv", Columns(positions=("y", "x"))
    ).recordings
    np.testing.assert_allclose(recording.positions, P[:, ::-1])
    headed = text(TABLE).replace(b",x,y,", b",x (mm),y (mm),")
    assert read(headed, "csv").unit == "mm"


def test_the_caller_names_what_is_what():
    table = {"stamp_ns": T * 1e9, "a": P[:, 0], "b": P[:, 1], "c": T}
    columns = Columns(time="stamp_ns", positions=("b", "a"), time_unit="ns", velocities=())
    (recording,) = read(text(table), "csv", columns).recordings
    np.testing.assert_allclose(recording.positions, P[:, ::-1])
    np.testing.assert_allclose(recording.times, T)
    bare = b"\n".join(text(TABLE).split(b"\n")[1:])
    (recording,) = read(bare, "csv", Columns(time="0", positions=("1", "2"))).recordings
    np.testing.assert_allclose(recording.positions, P)


ERRORS = {
    "no such column": ("csv", text(TABLE), Columns(positions=("x", "z")), "Did you mean|'z'"),
    "a word": ("csv", text(TABLE).replace(b"0.1,", b"soon,", 1), None, "'soon' in line 3"),
    "a word below a comment": (
        "csv",
        b"# pen\n\n" + text(TABLE).replace(b"0.1,", b"soon,", 1),
        None,
        "line 5",
    ),
    "other names": ("csv", text({"zeit": T, "x": T, "y": T}), None, "got zeit, x, y: name"),
    "no heading and a group": ("csv", b"1,0,2,3\n1,1,2,3", None, "--group 0 --time 1"),
    "a row too short": ("csv", text(TABLE) + b"\n1,2", None, "5 cells in line 10.*got 2"),
    "no heading": ("csv", b"\n".join(text(TABLE).split(b"\n")[1:]), None, "--positions 1 2"),
    "no times": ("csv", text({"x": T, "y": T}), None, "--dt"),
    "twice the same heading": ("csv", b"t,x,x\n1,2,3\n2,3,4", None, "more than once"),
    "nothing": ("csv", b"", None, "got an empty file"),
    "no arrays": ("npz", b"", None, "got an empty file"),
    "a comment": ("csv", b"# t,x,y\n", None, "got comments and empty lines alone"),
    "a heading": ("csv", b"t,x,y\n", None, "a line for each sample, got a single line"),
    "no text in JSON lines": ("jsonl", b"\xff", None, "save it as UTF-8"),
    "no text": ("csv", b"\xff\xfe\x00", None, "UTF-8"),
    "objects": ("npz", npz(x=np.array([{}])), None, "numbers and words"),
    "no positions": ("npz", npz(a=np.zeros(())), None, "--positions"),
    "no zip": ("npz", b"PK not", None, "numpy.savez"),
    "version 7.3": ("mat", b"MATLAB 7.3 MAT-file" + bytes(200), None, "-v7"),
    "no MAT file": ("mat", b"something else", None, "to be a MAT file"),
    "no JSON": ("jsonl", b'{"t": 1}\n{"t"', None, "line 2"),
    "deep JSON": ("jsonl", b"[" * 200_000, None, "line 1"),
    "other keys": ("jsonl", lines([{"t": 1, "x": 2}, {"t": 2}]), None, "object 2"),
    "an empty object": ("jsonl", b"{}", None, "JSON objects"),
    "ragged": ("jsonl", lines([{"t": 0, "p": [1]}, {"t": 1, "p": [1, 2]}]), None, "numbers"),
}


@pytest.mark.parametrize(("kind", "content", "columns", "message"), ERRORS.values(), ids=ERRORS)
def test_errors_say_what_was_expected_and_what_came(kind, content, columns, message):
    with pytest.raises(RecordingError, match=message) as found:
        read(content, kind, columns)
    assert "xpected" in str(found.value)


def test_recordings_of_a_table_without_a_heading_are_named_in_words():
    content = text({"g": NUMBERED, **TWICE}).split(b"\n", 1)[1]
    columns = Columns(group="0", time="1", positions=("2", "3"))
    assert [r.name for r in read(content, "csv", columns).recordings] == [
        "it, recording 1", "it, recording 2",
    ]  # fmt: skip


def test_names_that_do_not_tell_the_format(tmp_path):
    path = tmp_path / "log.xyz"
    path.write_bytes(text(TABLE))
    with pytest.raises(RecordingError, match="--format"):
        read_recordings([path])
    assert len(read_recordings([path], format="csv").recordings) == 1
    with pytest.raises(FileNotFoundError, match="got none"):
        read_recordings([tmp_path / "absent.csv"])


# Files that would fill the memory -----------------------------------------------------------


def claim(shape):
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        stream, {"descr": "<f8", "fortran_order": False, "shape": shape}
    )
    return stream.getvalue()


def test_a_header_that_claims_a_terabyte_is_refused_before_memory_is_taken():
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("positions.npy", claim((2**37, 2)) + bytes(64))
    with pytest.raises(RecordingError, match="takes 2199023255552 bytes, and has 64"):
        read(stream.getvalue(), "npz")
    with pytest.raises(RecordingError, match="takes"):
        read(claim((2**60, 2**60)), "npz")


def test_what_unpacks_to_too_much_is_refused(monkeypatch):
    monkeypatch.setattr("iflow_gym.recordings.numpy_files.MOST_BYTES", 10_000)
    monkeypatch.setattr("iflow_gym.recordings.matlab.MOST_BYTES", 10_000)
    assert MOST_BYTES <= 2**30
    stream = io.BytesIO()
    np.savez_compressed(stream, positions=np.zeros((10_000, 2)))
    with pytest.raises(RecordingError, match="unpacks to more than"):
        read(stream.getvalue(), "npz")
    with pytest.raises(RecordingError, match="unpacks to more than"):
        read(mat(True, positions=np.zeros((10_000, 2))), "mat")
    header = mat(x=T)[:128]
    packed = zlib.compress(bytes(100_000))
    bomb = header + (15).to_bytes(4, "little") + len(packed).to_bytes(4, "little") + packed
    with pytest.raises(RecordingError, match="unpacks to more than"):
        read(bomb, "mat")


FUZZED = {
    "csv": text({**TABLE, "demo": np.repeat([1, 2], 4)}),
    "npz": npz(times=T, positions=P),
    "mat": mat(t=T, pos=P, vel=V),
    "compressed": mat(True, demos=CELLS),
    "jsonl": lines([{"t": t, "position": p} for t, p in zip(T.tolist(), P.tolist(), strict=True)]),
}


@pytest.mark.parametrize("name", FUZZED)
@settings(max_examples=80, deadline=None)
@given(data=st.data())
def test_a_damaged_file_gives_recordings_or_the_clear_error(name, data):
    content = bytearray(FUZZED[name])
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(content) - 1))
        content[at] = data.draw(st.integers(0, 255))
    if data.draw(st.booleans()):
        del content[data.draw(st.integers(0, len(content) - 1)) :]
    kind = {"compressed": "mat"}.get(name, name)
    with contextlib.suppress(RecordingError):  # anything else is a failure
        recordings = read(bytes(content), kind).recordings
        assert all(r.positions.dtype == np.float64 for r in recordings)


@pytest.mark.parametrize(
    ("name", "apart", "doubted"), [("t", 10.0, True), ("t", 0.1, False), ("t_ms", 10.0, False)]
)
def test_seconds_that_hardly_are_are_doubted(name, apart, doubted):
    table = {name: np.arange(8) * apart, "x": P[:, 0], "y": P[:, 1]}
    reading = read_recordings([Source("pen.csv", content=text(table))], format="csv")
    assert ("--time-unit ms" in str(reading.notes[0])) is doubted
