"""Minari datasets: written, loaded, replayed in the environment that they give back, read again."""

import numpy as np
import pytest

from iflow_gym.cli import run
from iflow_gym.datasets.minari_export import (
    MinariError,
    dataset_id,
    export_minari,
    exportable,
)
from iflow_gym.recordings import CleanUp, Columns, RecordingError, clean, read_recordings

minari = pytest.importorskip("minari")

ANGLE = "iflow/LASA-Angle-v0"


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(tmp_path_factory.mktemp("minari")))
        yield export_minari(ANGLE)


def test_every_dataset_has_an_id_of_its_own():
    ids = [dataset_id(env_id) for env_id in exportable()]
    assert dataset_id(ANGLE) == "iflow/LASA-Angle/human-v0"
    assert len(set(ids)) == len(ids) == 30 + 8 + 2
    with pytest.raises(MinariError, match="Disturbed has LASA's"):
        dataset_id("iflow/Disturbed-Angle-v0")


def test_the_environment_comes_back_and_answers_as_it_did(exported):
    dataset = minari.load_dataset(exported)
    env = dataset.recover_environment()
    demonstrations = env.unwrapped.demonstrations
    assert dataset.total_episodes == len(demonstrations) == 7
    for episode in dataset.iterate_episodes([0, 5]):
        assert dataset.spec.action_space.contains(episode.actions[0])
        assert dataset.spec.observation_space.contains(episode.observations[0])
        observation, _ = env.reset(options={"demonstration": int(episode.id)})
        replayed, rewards, truncations = [observation], [], []
        for action in episode.actions:
            observation, reward, terminated, truncated, _ = env.step(action)
            assert not terminated
            replayed.append(observation)
            rewards.append(reward)
            truncations.append(truncated)
        np.testing.assert_array_equal(episode.observations, replayed)
        np.testing.assert_array_equal(episode.rewards, rewards)
        np.testing.assert_array_equal(episode.truncations, truncations)
        assert truncations == [False] * 998 + [True]
        path = demonstrations.positions[int(episode.id)]
        np.testing.assert_allclose(episode.observations, path, rtol=0, atol=1e-6)  # mm


def test_metadata_say_who_how_and_where(exported):
    metadata = minari.load_dataset(exported).storage.metadata
    assert metadata["author"] == {"LASA laboratory, EPFL"}
    assert metadata["algorithm_name"] == "Human handwriting, replayed"
    assert metadata["code_permalink"]
    for word in ("mm", "goal", "float32", "Khansari-Zadeh"):
        assert word in metadata["description"]


def test_a_dataset_is_not_written_over_unless_told(exported):
    with pytest.raises(MinariError, match="--replace"):
        export_minari(ANGLE)
    assert run(["data", "export-minari", "LASA-Angle", "--replace"]) == 0


def test_it_is_imported_as_the_same_motion(exported):
    motion = clean(
        read_recordings([exported]), CleanUp(unit="mm", trim=False, smooth=0.0, goal=(0.0, 0.0))
    ).demonstrations
    env = minari.load_dataset(exported).recover_environment()
    for mine, theirs in zip(motion.positions, env.unwrapped.demonstrations.positions, strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=0, atol=1e-6)
    np.testing.assert_allclose(motion.dt, env.unwrapped.demonstrations.dt, rtol=1e-9)
    (first, *_) = read_recordings([exported], Columns(positions=("1",), dt=0.5)).recordings
    assert first.positions.shape == (1000, 1)
    with pytest.raises(RecordingError, match="0 to 1"):
        read_recordings([exported], Columns(positions=("2",)))
    with pytest.raises(RecordingError, match="minari list local"):
        read_recordings(["iflow/nothing-v0"])
