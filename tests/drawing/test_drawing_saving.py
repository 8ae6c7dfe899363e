"""What is saved is what was fitted, and lies where it should."""

import numpy as np
import pytest
from drawing_hands import ellipse, reach

from iflow_gym import Demonstrations
from iflow_gym.drawing.saving import DEFAULT_NAME, file_stem, save_drawing
from iflow_gym.drawing.strokes import drawing_of


@pytest.mark.parametrize(
    ("name", "stem"),
    [
        ("my motion", "my-motion"),
        ("../../etc/passwd", "etc-passwd"),
        ("..", DEFAULT_NAME),
        ("", DEFAULT_NAME),
        ("/", DEFAULT_NAME),
        ("a\0b\nc", "a-b-c"),
        ("C:\\x", "C-x"),
        ("nul", "drawing-nul"),
        ("S_1-é", "S_1"),
        ("x" * 300, "x" * 60),
    ],
)
def test_names(name, stem):
    assert file_stem(name) == stem


@pytest.mark.parametrize("kind", ["goal", "cycle"])
def test_the_table_reads_back_exactly(tmp_path, kind):
    strokes = [reach(k) for k in range(2)] if kind == "goal" else [ellipse()]
    motion = drawing_of(strokes, kind).demonstrations
    table, model = save_drawing(tmp_path / "new", "m", motion, b"model")
    assert model.read_bytes() == b"model"
    assert table.read_text().splitlines()[0] == "demo,t,x,y"
    rows = np.genfromtxt(table, delimiter=",", skip_header=1)
    demos = [rows[rows[:, 0] == i] for i in range(len(motion))]
    again = Demonstrations.from_arrays(
        [d[:, 2:] for d in demos], times=[d[:, 1] for d in demos], period=motion.period
    )
    for mine, theirs in zip(again.positions, motion.positions, strict=True):
        assert (mine == theirs).all()
    assert again.dt == pytest.approx(motion.dt, rel=1e-12)


def test_nothing_is_overwritten(tmp_path):
    motion = drawing_of([reach()], "goal").demonstrations
    (tmp_path / "m-2.safetensors").symlink_to(tmp_path / "nowhere")
    saved = [save_drawing(tmp_path, "m", motion, bytes([k])) for k in range(3)]
    assert [table.name for table, _ in saved] == ["m.csv", "m-3.csv", "m-4.csv"]
    assert [model.read_bytes() for _, model in saved] == [b"\0", b"\1", b"\2"]
    assert not (tmp_path / "nowhere").exists()
