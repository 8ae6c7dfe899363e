"""Minari datasets: what goes out is real transitions, what comes in is what it is said to be."""

import contextlib
import hashlib
import io
import json
import os
import shutil
import sys
import warnings

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import iflow_gym.datasets.recorded as recorded
from iflow_gym import minari_datasets
from iflow_gym.datasets.lasa import load_lasa
from iflow_gym.minari_datasets import dataset_id_of, export, export_minari, read_minari
from iflow_gym.minari_datasets.provenance import NOT_EXPORTED, PROVENANCE
from iflow_gym.minari_datasets.store import ROOT_VARIABLE, DatasetError, datasets_root
from iflow_gym.recordings import CleanUp, RecordingError, clean, read_recordings

minari = pytest.importorskip("minari")
pytest.importorskip("h5py")

EXPORTED = {
    "iflow/LASA-Angle-v0": "iflow/LASA-Angle/human-v0",
    "iflow/Letter-O-v0": "iflow/Letter-O/synthetic-v0",
    "iflow/Drumming-v0": "iflow/Drumming/scripted-v0",
}
every_export = pytest.mark.parametrize("env_id", EXPORTED)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return tmp_path_factory.mktemp("minari")


@pytest.fixture
def exported(request, root, monkeypatch):
    """A dataset in a root that all tests of this file share, loaded as anyone would."""
    env_id = request.getfixturevalue("env_id")
    if not (root / EXPORTED[env_id]).exists():
        export_minari(env_id, root=root)
    monkeypatch.setenv(ROOT_VARIABLE, str(root))
    return minari.load_dataset(EXPORTED[env_id])


@pytest.fixture
def angle(root):
    if not (root / EXPORTED["iflow/LASA-Angle-v0"]).exists():
        export_minari("iflow/LASA-Angle-v0", root=root)
    return "iflow/LASA-Angle/human-v0"


def metadata_of(dataset):
    return list(dataset.storage.get_episode_metadata(range(dataset.total_episodes)))


def replayed(env, episode, metadata):
    """Step through an episode's actions from where its options reset to."""
    options = {key: int(value) for key, value in metadata["options"].items()}
    observation, info = env.reset(seed=metadata["seed"], options=options)
    yield observation, None, None, None, info
    for action in episode.actions:
        yield env.step(action)


# Out --------------------------------------------------------------------------------------------


@every_export
def test_every_episode_is_what_the_recovered_environment_does(env_id, exported):
    env = exported.recover_environment()
    assert type(env.unwrapped) is type(gym.make(env_id).unwrapped)
    demonstrations = env.unwrapped.demonstrations
    assert exported.total_episodes == len(demonstrations)
    assert exported.total_steps == sum(len(p) - 1 for p in demonstrations.positions)
    assert exported.observation_space == env.observation_space
    assert exported.action_space == env.action_space
    some = range(1 if "Drumming" in env_id else len(demonstrations))  # the arm takes its time
    metadata = metadata_of(exported)
    for i in some:
        episode, n = exported[i], len(demonstrations.positions[i]) - 1
        assert len(episode) == n
        assert all(a in env.action_space for a in episode.actions)
        assert all(o in env.observation_space for o in episode.observations)
        assert not episode.terminations.any()
        assert episode.truncations.tolist() == [False] * (n - 1) + [True]
        assert metadata[i]["dt"] == demonstrations.dt[i]
        steps = replayed(env, episode, metadata[i])
        for k, (observation, reward, terminated, truncated, info) in enumerate(steps):
            np.testing.assert_array_equal(observation, episode.observations[k])
            for name, values in episode.infos.items():
                assert values[k] == info[name]
            if k:
                assert reward == episode.rewards[k - 1]
                assert terminated == episode.terminations[k - 1]
                assert truncated == episode.truncations[k - 1]
        assert k == n


@every_export
def test_observations_are_the_recordings(env_id, exported):
    demonstrations = gym.make(env_id).unwrapped.demonstrations
    allowed = 2e-3 if "Drumming" in env_id else 1e-7  # of the diagonal; the arm is an arm
    for episode, positions in zip(exported, demonstrations.positions, strict=True):
        off = np.abs(episode.observations - positions).max()
        assert off <= allowed * demonstrations.bounding_box.diagonal
        assert episode.observations.dtype == np.float64


def test_force_mode_is_a_dataset_of_its_own_and_agrees_with_get_dataset(root):
    dataset = export_minari("iflow/LASA-Angle-v0", control_mode="force", root=root)
    assert dataset.spec.dataset_id == "iflow/LASA-Angle/human-force-v0"
    env = dataset.recover_environment()
    assert env.unwrapped.control_mode == "force"
    flat = env.unwrapped.get_dataset()
    starts = np.concatenate([e.observations[:-1] for e in dataset])
    actions = np.concatenate([e.actions for e in dataset])
    rewards = np.concatenate([e.rewards for e in dataset])
    # The actions there are not rounded to float32.
    scale = np.abs(flat["observations"]).max(axis=0)
    np.testing.assert_allclose(starts / scale, flat["observations"] / scale, atol=1e-6)
    np.testing.assert_allclose(actions, flat["actions"], atol=1e-5)
    np.testing.assert_allclose(rewards, flat["rewards"], atol=1e-4)


@every_export
def test_a_dataset_says_where_it_comes_from(env_id, exported):
    listed = minari.list_local_datasets()[EXPORTED[env_id]]
    provenance = PROVENANCE[env_id.split("/")[1].split("-")[0]]
    demonstrations = gym.make(env_id).unwrapped.demonstrations
    assert set(listed["author"]) == provenance.authors
    assert listed["algorithm_name"] == provenance.algorithm
    for part in (provenance.reference, provenance.licence, env_id, demonstrations.length_unit):
        assert part in listed["description"]
    assert listed["dataset_size"] > 0
    ours = listed["iflow_gym"]
    assert ours["demonstrations_sha256"] == demonstrations.sha256
    assert ours["version"] == iflow_gym_version()
    assert f"iflow-gym>={ours['version']}" in listed["requirements"]
    assert any("mujoco" in r for r in listed["requirements"]) == ("Drumming" in env_id)
    held_out = [bool(m["held_out"]) for m in metadata_of(exported)]
    n = len(demonstrations) - demonstrations.held_out
    assert held_out == [False] * n + [True] * demonstrations.held_out


def iflow_gym_version():
    import iflow_gym

    return iflow_gym.__version__


@every_export
def test_it_comes_back_as_demonstrations(env_id, exported, root):
    original = gym.make(env_id).unwrapped.demonstrations
    back = read_minari(EXPORTED[env_id], root=root)
    assert (back.name, back.length_unit) == (original.name, original.length_unit)
    assert (back.dt, back.period, back.held_out) == (
        original.dt,
        original.period,
        original.held_out,
    )
    assert (back.goal is None) == (original.goal is None)
    if original.goal is not None:
        np.testing.assert_array_equal(back.goal, original.goal)
    for episode, positions in zip(exported, back.positions, strict=True):
        np.testing.assert_array_equal(positions, episode.observations)
    assert EXPORTED[env_id] in back.source
    assert original.source in back.source


def test_recordings_from_a_mirror_do_not_name_it(tmp_path, monkeypatch):
    """Two ellipses stand in for the recorded I."""
    angle = np.linspace(0, 8 * np.pi, 400)
    rounds = np.stack([np.column_stack([np.cos(angle), s * np.sin(angle)]) for s in (1, 1.1)])
    content = io.BytesIO()
    np.save(content, rounds)
    old = recorded.FILES["I"]
    digest = hashlib.sha256(content.getvalue()).hexdigest()
    stand_in = recorded.RecordedFile(old.path, old.mirrored, digest)
    monkeypatch.setitem(recorded.FILES, "I", stand_in)
    monkeypatch.setattr(recorded, "_PERIODS", {})
    monkeypatch.delenv(recorded.MIRROR_VARIABLE, raising=False)
    mirror = tmp_path / "mirror"
    (mirror / old.mirrored).parent.mkdir(parents=True)
    (mirror / old.mirrored).write_bytes(content.getvalue())
    dataset = export_minari("iflow/LetterRecorded-I-v0", root=tmp_path / "root", mirror=mirror)
    assert dataset.spec.dataset_id == "iflow/LetterRecorded-I/human-v0"
    text = (tmp_path / "root/iflow/LetterRecorded-I/human-v0/data/metadata.json").read_text()
    assert str(mirror) not in text
    assert "Copyright (c) 2020 Julen Urain" in text
    env = dataset.recover_environment(mirror=str(mirror))
    for episode, metadata in zip(dataset, metadata_of(dataset), strict=True):
        for k, step in enumerate(replayed(env, episode, metadata)):
            np.testing.assert_array_equal(step[0], episode.observations[k])


def test_every_environment_has_a_dataset_or_a_reason():
    ids = [i for i in gym.registry if i.startswith("iflow/")]
    families = {i.split("/")[1].split("-")[0] for i in ids}
    assert families == {*PROVENANCE, *NOT_EXPORTED}
    names = set()
    for env_id in ids:
        if env_id.split("/")[1].split("-")[0] in PROVENANCE:
            names.add(dataset_id_of(env_id))
    assert len(names) == 30 + 4 + 4 + 2


@pytest.mark.parametrize(
    ("env_id", "message"),
    [
        ("iflow/PointMass-v0", "demonstrations are the caller's"),
        ("iflow/Disturbed-Angle-v0", "export the LASA environment"),
        ("iflow/LASA-Nothing-v0", "Expected the id of an environment"),
        ("CartPole-v1", "Expected the id of an environment"),
        ("iflow/../../LASA-Angle-v0", "Expected the id of an environment"),
        (None, "got None"),
    ],
)
def test_what_has_no_demonstrations_of_its_own_is_refused(env_id, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        export_minari(env_id, root=tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_dataset_is_replaced_when_asked_and_only_if_it_is_ours(tmp_path, monkeypatch):
    monkeypatch.setattr(export, "_episodes", one_episode)
    env_id, place = "iflow/LASA-Line-v0", tmp_path / "iflow/LASA-Line/human-v0"
    export_minari(env_id, root=tmp_path)
    before = (place / "data/main_data.hdf5").stat().st_ino
    with pytest.raises(FileExistsError, match="pass overwrite=True"):
        export_minari(env_id, root=tmp_path)
    export_minari(env_id, root=tmp_path, overwrite=True)
    assert (place / "data/main_data.hdf5").stat().st_ino != before
    assert [p.name for p in tmp_path.iterdir()] == ["iflow"]
    for text in ("{}", "no JSON"):
        (place / "data/metadata.json").write_text(text)
        with pytest.raises(FileExistsError, match="something else: it is left alone"):
            export_minari(env_id, root=tmp_path, overwrite=True)
        assert (place / "data/metadata.json").read_text() == text


def one_episode(env):
    """The first recording's first steps, twice over."""
    observation, _ = env.reset(options={"demonstration": 0})
    for _ in range(len(env.unwrapped.demonstrations)):
        yield {
            "observations": np.array([observation] * 3),
            "actions": np.zeros((2, 2), np.float32),
            "rewards": np.zeros(2),
            "terminations": np.array([False, False]),
            "truncations": np.array([False, True]),
        }


def test_an_export_that_fails_leaves_nothing(tmp_path, monkeypatch):
    def failing(env):
        yield from list(one_episode(env))[:1]
        raise RuntimeError("the power is off")

    monkeypatch.setattr(export, "_episodes", failing)
    monkeypatch.setenv(ROOT_VARIABLE, "before")
    with pytest.raises(RuntimeError, match="the power is off"):
        export_minari("iflow/LASA-Line-v0", root=tmp_path)
    assert not list(tmp_path.iterdir())
    with datasets_root(tmp_path / "x") as there:
        assert there == tmp_path / "x"
    with datasets_root(None) as there:
        assert str(there) == "before"


@pytest.mark.parametrize("module", ["minari", "h5py"])
def test_without_minari_the_error_names_the_extra(module, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, module, None)
    for call in (
        lambda: minari_datasets.export_minari("iflow/LASA-Angle-v0", root=tmp_path),
        lambda: minari_datasets.read_minari("iflow/LASA-Angle/human-v0", root=tmp_path),
    ):
        with pytest.raises(ImportError, match=r"pip install 'iflow-gym\[minari\]'"):
            call()


# In ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def foreign(tmp_path_factory):
    """A dataset of another program: a dictionary of observations, as of a maze, in float32."""
    from minari.data_collector.episode_buffer import EpisodeBuffer

    folder = tmp_path_factory.mktemp("foreign")
    box = gym.spaces.Box(-9, 9, (4,), np.float32)
    inner = gym.spaces.Dict(
        {"pose": box, "id": gym.spaces.Box(0, 9, (), np.float32), "name": gym.spaces.Text(3)}
    )
    space = gym.spaces.Dict({"state": inner, "goal": gym.spaces.Box(-9, 9, (2,), np.float32)})
    episodes = []
    for n in (30, 40):
        t = np.linspace(1, 0, n)[:, None]
        pose = np.hstack([t, np.ones((n, 1)), 2 * t**2, np.zeros((n, 1))]).astype(np.float32)
        state = {"pose": pose, "id": np.zeros(n, np.float32), "name": ["abc"] * n}
        episodes.append(
            EpisodeBuffer(
                observations={"state": state, "goal": np.zeros((n, 2), np.float32)},
                actions=np.zeros((n - 1, 2), np.float32),
                rewards=np.zeros(n - 1),
                terminations=np.zeros(n - 1, bool),
                truncations=np.arange(n - 1) == n - 2,
            )
        )
    with datasets_root(folder), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # who made it and how is not said
        minari.create_dataset_from_buffers(
            "maze/small-v3",
            episodes,
            observation_space=space,
            action_space=gym.spaces.Box(-1, 1, (2,), np.float32),
        )
    return folder


def read(folder, **changes):
    options = {"key": "state/pose", "indices": (0, 2), "dt": 0.02} | changes
    return read_minari("maze/small-v3", root=folder, **options)


def test_positions_of_another_dataset(foreign):
    motion = read(foreign)
    assert (motion.name, len(motion), motion.n_dims) == ("maze/small-v3", 2, 2)
    for positions, n in zip(motion.positions, (30, 40), strict=True):
        t = np.linspace(1, 0, n)
        expected = np.column_stack([t, 2 * t**2]).astype(np.float32)
        np.testing.assert_array_equal(positions, expected)
    assert motion.dt == (0.02, 0.02)
    np.testing.assert_array_equal(motion.goal, [0, 0])
    expected = [-1 / 29 / 0.02, -4 * 24 / 29**2 / 0.02]
    np.testing.assert_allclose(motion.velocities[0][5], expected, rtol=1e-5)
    swapped = read(foreign, indices=[2, 0], episodes=[1], name="mine", length_unit="cell")
    assert (swapped.name, swapped.length_unit, len(swapped)) == ("mine", "cell", 1)
    np.testing.assert_array_equal(swapped.positions[0], motion.positions[1][:, ::-1])
    assert read(foreign, period=0.5).period == 0.5


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"key": None}, r"Expected key=, .*'goal': \(30, 2\), 'state': a dictionary"),
        ({"key": "state"}, r"Expected key=, .*'pose': \(30, 4\)"),
        ({"key": "stat"}, "Expected observations to have 'stat', got 'goal'"),
        ({"key": "state/pose/x"}, "have 'x', got no dictionary"),
        ({"key": "state/id"}, r"shape \(T, n\), got float32 of shape \(30,\)"),
        ({"key": "state/name"}, r"of real numbers and shape \(T, n\), got"),
        ({"indices": None}, r"which of the 4 components .*range\(4\) if all"),
        ({"indices": ()}, r"different components .*, from 0 to 3, got \[\]"),
        ({"indices": (0, 4)}, r"from 0 to 3, got \[0, 4\]"),
        ({"indices": (-1, 0)}, r"from 0 to 3, got \[-1, 0\]"),
        ({"indices": (2, 2)}, r"different components"),
        ({"dt": None}, "Expected dt=.*'maze/small-v3' does not say it"),
        ({"dt": -1.0}, "Expected dt > 0"),
        ({"episodes": [2]}, r"Expected episodes from 0 to 1, got \[2\]"),
        ({"episodes": []}, r"Expected episodes from 0 to 1, got \[\]"),
        ({"goal": [5, 5]}, "end within"),
    ],
)
def test_what_is_not_said_or_not_true_is_refused(foreign, changes, message):
    with pytest.raises(ValueError, match=message):
        read(foreign, **changes)


@pytest.mark.parametrize(
    "dataset_id", ["../maze/small-v3", "/etc/x-v0", "a/../b-v0", "a", "", None]
)
def test_an_id_that_is_none_is_refused(dataset_id, foreign):
    with pytest.raises(ValueError, match="Expected an id of a Minari dataset"):
        read_minari(dataset_id, root=foreign)


def test_a_dataset_that_is_not_there_is_not_downloaded(foreign, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"got maze/small-v3: run `minari download x-v0`"):
        read_minari("x-v0", root=foreign)
    with pytest.raises(FileNotFoundError, match="got none"):
        read_minari("x-v0", root=tmp_path / "absent")


def test_what_the_caller_says_counts_more_than_what_the_dataset_says(angle, root):
    motion = read_minari(angle, dt=0.5, period=30.0, indices=[1], episodes=[0, 2], root=root)
    assert (motion.dt, motion.period, motion.n_dims) == ((0.5, 0.5), 30.0, 1)
    full = load_lasa("Angle")
    for mine, i in zip(motion.positions, (0, 2), strict=True):
        np.testing.assert_allclose(mine[:, 0], full.positions[i][:, 1], atol=1e-5)


def test_metadata_are_plain_json(angle, root):
    text = (root / angle / "data/metadata.json").read_text()
    assert json.loads(text)["iflow_gym"]["goal"] == [0.0, 0.0]


# Damage -----------------------------------------------------------------------------------------

LINE = "iflow/LASA-Line/human-v0"


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The folder of a small dataset."""
    folder = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(export, "_episodes", moving)
        export_minari("iflow/LASA-Line-v0", root=folder)
    return folder


def moving(env):
    """A straight line of 20 samples for each recording."""
    for episode in one_episode(env):
        n = 20
        last = np.arange(n - 1) == n - 2
        yield episode | {
            "observations": np.linspace([40.0, 20.0], [0.0, 0.0], n),
            "actions": np.zeros((n - 1, 2), np.float32),
            "rewards": np.zeros(n - 1),
            "terminations": np.zeros(n - 1, bool),
            "truncations": last,
            "infos": {"time": 0.1 * np.arange(n)},
        }


@pytest.fixture
def damaged(whole, tmp_path, monkeypatch):
    """A copy to damage: its root and the folder of its data."""
    root = tmp_path / "root"
    shutil.copytree(whole, root)
    monkeypatch.setenv(ROOT_VARIABLE, str(root))
    return root, root / LINE / "data"


def read_both_ways(root):
    """Read a dataset as both readers do; return their clear errors."""
    errors = []
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            read_minari(LINE, root=root)
        except ValueError as error:
            errors.append(str(error))
        try:
            clean(read_recordings([LINE]), CleanUp(unit="mm", trim=False))
        except RecordingError as error:
            errors.append(str(error))
    return errors


def with_metadata(**changes):
    def change(data):
        file = data / "metadata.json"
        file.write_text(json.dumps(json.loads(file.read_text()) | changes))

    return change


def with_observations(make):
    def change(data):
        import h5py

        with h5py.File(data / "main_data.hdf5", "a") as file:
            del file["episode_0/observations"]
            make(file["episode_0"])

    return change


def claiming_terabytes(group):
    group.create_dataset("observations", shape=(10**12, 2), chunks=(1000, 2), dtype="f8")


DAMAGE = {
    "no arrays": (lambda data: (data / "main_data.hdf5").unlink(), "No data found"),
    "empty arrays": (lambda data: (data / "main_data.hdf5").write_bytes(b""), "signature"),
    "cut arrays": (lambda data: os.truncate(data / "main_data.hdf5", 5000), "truncated"),
    "no metadata": (lambda data: (data / "metadata.json").unlink(), "metadata.json"),
    "no JSON": (lambda data: (data / "metadata.json").write_text("x"), "damaged"),
    "deep JSON": (lambda data: (data / "metadata.json").write_text("[" * 100_000), "damaged"),
    "a list": (lambda data: (data / "metadata.json").write_text("[]"), "its metadata are a list"),
    "of another program": (lambda data: (data / "metadata.json").write_text("{}"), "None episodes"),
    "too many episodes": (with_metadata(total_episodes=10**9), "1000000000 episodes"),
    "an unknown space": (with_metadata(observation_space="{}"), "damaged"),
    "no observations": (with_observations(lambda group: None), "observations"),
    "a group": (with_observations(lambda group: group.create_group("observations")), "damaged"),
    "terabytes": (with_observations(claiming_terabytes), "512 are read"),
    "nan": (
        with_observations(
            lambda g: g.create_dataset("observations", data=np.full((20, 2), np.nan))
        ),
        "NaN",
    ),
    "words": (with_observations(lambda g: g.create_dataset("observations", data="a")), "numbers"),
    "complex": (
        with_observations(
            lambda g: g.create_dataset("observations", data=np.ones((20, 2), complex))
        ),
        "numbers",
    ),
}


def test_what_is_damaged_below_can_be_read_when_it_is_whole(damaged):
    assert read_both_ways(damaged[0]) == []


@pytest.mark.parametrize("name", DAMAGE)
def test_a_damaged_dataset_is_told(name, damaged):
    root, data = damaged
    damage, message = DAMAGE[name]
    damage(data)
    errors = read_both_ways(root)
    assert len(errors) == 2
    assert all(e.startswith("Expected") and message in e for e in errors), errors


@pytest.mark.parametrize(
    "said", [None, [], "x", {"n_dims": "two"}, {"n_dims": 10**9}, {"goal": "x"}, {"name": 3}]
)
def test_what_export_said_is_looked_at(said, damaged):
    with_metadata(iflow_gym=said)(damaged[1])
    with pytest.raises(DatasetError, match="Export or download it again"):
        read_minari(LINE, root=damaged[0])


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_a_dataset_with_other_bytes_gives_recordings_or_the_clear_error(data, whole):
    name = data.draw(st.sampled_from(["main_data.hdf5", "metadata.json"]))
    file = whole / LINE / "data" / name
    before = file.read_bytes()
    content = bytearray(before)
    for _ in range(data.draw(st.integers(1, 6))):
        at = data.draw(st.integers(0, len(content) - 1))
        content[at] = data.draw(st.integers(0, 255))
    if data.draw(st.booleans()):
        del content[data.draw(st.integers(0, len(content) - 1)) :]
    file.write_bytes(content)
    try:
        with datasets_root(whole), contextlib.suppress(ImportError):  # another format's package
            read_both_ways(whole)
    finally:
        file.write_bytes(before)
