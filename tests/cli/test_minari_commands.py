"""Datasets written by the command, and read back as recordings of one's own."""

import numpy as np
import pytest

from iflow_gym.cli import run
from iflow_gym.minari_datasets import exportable
from iflow_gym.recordings import CleanUp, Columns, RecordingError, clean, read_recordings

minari = pytest.importorskip("minari")


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(tmp_path_factory.mktemp("minari")))
        assert run(["data", "export-minari", "LASA-Angle"]) == 0
        yield "iflow/LASA-Angle/human-v0"


def test_all_that_have_demonstrations_of_their_own_can_be_exported():
    assert len(exportable()) == 30 + 8 + 2


def test_a_dataset_is_not_written_over_unless_told(exported, capsys):
    assert run(["data", "export-minari", "LASA-Angle"]) == 1
    assert run(["data", "export-minari", "LASA-Angle", "--replace"]) == 0
    assert run(["data", "export-minari", "Disturbed-*"]) == 2
    assert "Unknown environment 'Disturbed-*'" in capsys.readouterr().err


def test_it_is_imported_as_the_same_motion(exported):
    motion = clean(
        read_recordings([exported]), CleanUp(unit="mm", trim=False, smooth=0.0, goal=(0.0, 0.0))
    ).demonstrations
    env = minari.load_dataset(exported).recover_environment()
    for mine, theirs in zip(motion.positions, env.unwrapped.demonstrations.positions, strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=0, atol=1e-6)
    np.testing.assert_allclose(motion.dt, env.unwrapped.demonstrations.dt, rtol=1e-9)
    with pytest.raises(RecordingError, match="0 to 1"):
        read_recordings([exported], Columns(positions=("2",)))
    with pytest.raises(RecordingError, match="minari list local"):
        read_recordings(["iflow/nothing-v0"])
