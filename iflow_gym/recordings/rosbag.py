"""Recordings from ROS 2 bags: a bag is a recording."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from iflow_gym.recordings.columns import Columns, Reading
from iflow_gym.recordings.raw import MOST_BYTES, RawRecording, RecordingError
from iflow_gym.recordings.reading import Source
from iflow_gym.recordings.steps import Note

AXES = ("x", "y", "z")

Values = Callable[[Any], Any]


def _xyz(point: Any) -> list[float]:
    return [point.x, point.y, point.z]


POSITIONS: dict[str, Values] = {
    "geometry_msgs/msg/PoseStamped": lambda m: _xyz(m.pose.position),
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda m: _xyz(m.pose.pose.position),
    "geometry_msgs/msg/PointStamped": lambda m: _xyz(m.point),
    "geometry_msgs/msg/TransformStamped": lambda m: _xyz(m.transform.translation),
    "geometry_msgs/msg/Vector3Stamped": lambda m: _xyz(m.vector),
    "geometry_msgs/msg/Pose": lambda m: _xyz(m.position),
    "geometry_msgs/msg/Point": _xyz,
    "geometry_msgs/msg/Vector3": _xyz,
    "nav_msgs/msg/Odometry": lambda m: _xyz(m.pose.pose.position),
    "sensor_msgs/msg/JointState": lambda m: list(m.position),
}
"""Where the position is, by the type of message."""

JOINTS = "sensor_msgs/msg/JointState"
MOST_MESSAGES = 5_000_000


def read(source: Source, columns: Columns) -> Reading:
    """Read the messages of one topic of a bag, of SQLite or MCAP files.

    Times are the messages' own stamps where they have one other than 0, else those at which they
    were recorded. `Columns.positions` chooses among x, y and z, or among the joints by name.

    Raises
    ------
    RecordingError
        If it is no bag, has no topic of a known type or several, or a message cannot be read.
    ImportError
        Without the extra ``rosbags``.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise ImportError(
            f"Expected the package rosbags to read ROS 2 bags, got {error}: pip install "
            "'iflow-gym[rosbags]'."
        ) from error
    if source.path is None:
        raise RecordingError("Expected the folder of a ROS 2 bag, got standard input.")
    path = source.path if source.path.is_dir() or _is_ros1(source.path) else source.path.parent
    if columns.dt is not None or columns.time is not None:
        raise RecordingError(
            f"Expected the stamps of the messages to be the times of {source.name}, got "
            f"{'--dt' if columns.dt is not None else '--time'}: leave it out."
        )
    try:
        size = sum(f.stat().st_size for f in _files(path))
        if size > 64 * MOST_BYTES:
            raise RecordingError(
                f"Expected a bag of at most {64 * MOST_BYTES >> 30} GiB at {source.name}, got "
                f"{size >> 30}."
            )
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
            return _topic(reader, source.name, columns)
    except RecordingError:
        raise
    except Exception as error:  # whatever rosbags, SQLite and the decoder make of other bytes
        raise RecordingError(
            f"Expected a ROS 2 bag at {source.name}, a folder with metadata.yaml, got something "
            f"else or a damaged one: {str(error).rstrip('.') or type(error).__name__}."
        ) from error


def _topic(reader: Any, name: str, columns: Columns) -> Reading:
    """Return the recording of one topic of an open bag."""
    usable = [c for c in reader.connections if c.msgtype in POSITIONS]
    known = sorted({c.topic for c in usable})
    listed = ", ".join(sorted({f"{c.topic} ({c.msgtype})" for c in reader.connections})) or "none"
    if columns.topic is not None:
        usable = [c for c in usable if c.topic == columns.topic]
    if not usable:
        raise RecordingError(
            f"Expected a topic with positions in {name}, such as poses, points or joint states"
            f"{'' if columns.topic is None else f', named {columns.topic}'}, got {listed}."
        )
    if len(topics := sorted({c.topic for c in usable})) > 1:
        raise RecordingError(
            f"Expected to know which topic of {name} is the motion, got {', '.join(known)}: name "
            f"it (--topic {topics[0]})."
        )
    kind = usable[0].msgtype
    stamps, recorded, points, names = [], [], [], None
    for connection, recorded_at, raw in reader.messages(connections=usable):
        message = reader.deserialize(raw, connection.msgtype)
        header = getattr(message, "header", None)
        stamp = header.stamp.sec * 10**9 + header.stamp.nanosec if header is not None else 0
        if kind == JOINTS:
            names = names or list(message.name)
            if list(message.name) != names:
                raise RecordingError(
                    f"Expected the joints {', '.join(names)} in every message of {name}, got "
                    f"{', '.join(message.name)}."
                )
        stamps.append(stamp)
        recorded.append(recorded_at)
        points.append(POSITIONS[kind](message))
        if len(points) > MOST_MESSAGES:
            raise RecordingError(f"Expected at most {MOST_MESSAGES} messages in {name}, got more.")
    if len({len(p) for p in points}) != 1:
        raise RecordingError(f"Expected messages of one length on {topics[0]} of {name}.")
    axes = list(AXES) if kind != JOINTS else (names or [])
    chosen = list(columns.positions) if columns.positions else axes
    if missing := [c for c in chosen if c not in axes]:
        raise RecordingError(
            f"Expected positions among {', '.join(axes)} of {name}, got {', '.join(missing)}."
        )
    own = all(stamps)
    # Nanoseconds since 1970 have more digits than a float: the first one is taken off before.
    whole = stamps if own else recorded
    times = np.array([t - whole[0] for t in whole], dtype=np.float64) * 1e-9
    values = np.array(points, dtype=np.float64)[:, [axes.index(c) for c in chosen]]
    label = f"{Path(name).name}, {topics[0]}"
    text = (
        f"took {'the stamps of' if own else 'when it recorded'} {len(points)} messages {kind}; "
        f"positions {', '.join(chosen)}"
    )
    said = {"time": "header" if own else "recorded", "positions": chosen, "topic": topics[0]}
    unit = None if kind == JOINTS else "m"
    return Reading([RawRecording(label, times, values)], [Note("columns", label, text, said)], unit)


def _is_ros1(path: Path) -> bool:
    return path.suffix == ".bag"


def _files(path: Path) -> list[Path]:
    return [path] if path.is_file() else [f for f in path.iterdir() if f.is_file()]
