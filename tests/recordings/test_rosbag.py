"""ROS 2 bags: written by rosbags, read as recordings."""

import numpy as np
import pytest

from iflow_gym.recordings import CleanUp, Columns, RecordingError, clean, read_recordings

pytest.importorskip("rosbags")

from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.LATEST)
N = 60
TIMES = np.arange(N) * 20_000_000  # ns
S = np.linspace(0, 1, N)
PATH = np.stack([1 - S, 0.5 * S**2, 0.1 * S], axis=1)


def message(kind, k, stamped=True):
    types = STORE.types
    start = 1_700_000_000_000_000_000
    ns = start + int(TIMES[k]) if stamped else 0
    stamp = types["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)
    header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="base")
    x, y, z = PATH[k].tolist()
    if kind == "sensor_msgs/msg/JointState":
        empty = np.array([])
        return types[kind](
            header=header, name=["a", "b", "c"], position=PATH[k], velocity=empty, effort=empty
        )
    point = types["geometry_msgs/msg/Point"](x=x, y=y, z=z)
    if kind == "geometry_msgs/msg/Point":
        return point
    turn = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    pose = types["geometry_msgs/msg/Pose"](position=point, orientation=turn)
    return types[kind](header=header, pose=pose)


def bag(path, topics, plugin=StoragePlugin.SQLITE3, stamped=True):
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        connections = {
            topic: (writer.add_connection(topic, kind, typestore=STORE), kind)
            for topic, kind in topics.items()
        }
        for k in range(N):
            for connection, kind in connections.values():
                raw = STORE.serialize_cdr(message(kind, k, stamped), kind)
                writer.write(connection, int(TIMES[k]) + 5_000_000, raw)
    return path


POSE = {"/tool": "geometry_msgs/msg/PoseStamped"}


@pytest.mark.parametrize("plugin", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
@pytest.mark.parametrize("kind", ["geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/Point"])
def test_a_topic_is_a_recording(tmp_path, plugin, kind):
    reading = read_recordings([bag(tmp_path / "bag", {"/tool": kind}, plugin)])
    (recording,) = reading.recordings
    np.testing.assert_array_equal(recording.positions, PATH)
    np.testing.assert_allclose(recording.times, TIMES * 1e-9, atol=1e-12)
    assert reading.unit == "m"
    motion = clean(reading, CleanUp(smooth=0.0, trim=False)).demonstrations
    np.testing.assert_allclose(motion.goal, PATH[-1])


def test_the_time_of_recording_counts_where_messages_have_no_stamp(tmp_path):
    reading = read_recordings([bag(tmp_path / "bag", POSE, stamped=False)])
    assert reading.notes[0].values["time"] == "recorded"
    np.testing.assert_allclose(reading.recordings[0].times, TIMES * 1e-9, atol=1e-12)


def test_joints_and_axes_are_chosen_by_name(tmp_path):
    path = bag(tmp_path / "bag", POSE | {"/joints": "sensor_msgs/msg/JointState"})
    columns = Columns(topic="/joints", positions=("c", "a"))
    (recording,) = read_recordings([path], columns).recordings
    np.testing.assert_array_equal(recording.positions, PATH[:, [2, 0]])
    columns = Columns(topic="/tool", positions=("x", "y"))
    (recording,) = read_recordings([path], columns).recordings
    np.testing.assert_array_equal(recording.positions, PATH[:, :2])
    with pytest.raises(RecordingError, match=r"--topic /joints"):
        read_recordings([path])
    with pytest.raises(RecordingError, match=r"/nothing, got .*/tool \(geometry_msgs"):
        read_recordings([path], Columns(topic="/nothing"))
    with pytest.raises(RecordingError, match="among a, b, c"):
        read_recordings([path], Columns(topic="/joints", positions=("d",)))
    with pytest.raises(RecordingError, match="leave it out"):
        read_recordings([path], Columns(topic="/joints", dt=0.1))


def test_a_damaged_bag_is_recordings_or_the_clear_error(tmp_path):
    path = bag(tmp_path / "bag", POSE)
    rng = np.random.default_rng(0)
    (storage,) = path.glob("*.db3")
    metadata = path / "metadata.yaml"
    for file in (storage, metadata):
        whole = file.read_bytes()
        for k in range(40):
            content = bytearray(whole)
            for _ in range(1 + 20 * (k % 2)):
                content[rng.integers(len(content))] = rng.integers(256)
            if k % 5 == 0:
                del content[rng.integers(len(content)) :]
            file.write_bytes(content)
            try:
                recordings = read_recordings([path]).recordings
            except RecordingError as error:
                assert "xpected" in str(error)  # noqa: PT017 (anything else is a failure)
            else:
                assert recordings[0].positions.shape[1] == 3
        file.write_bytes(whole)
    with pytest.raises(RecordingError, match="a folder with metadata"):
        read_recordings([tmp_path], format="rosbag")
