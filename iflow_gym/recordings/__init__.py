"""Recordings of one's own: read them from files, clean them, make demonstrations of them.

>>> from iflow_gym.recordings import CleanUp, Columns, clean, read_recordings
>>> raw = read_recordings(["reach.csv"], Columns(group="demo"))  # doctest: +SKIP
>>> cleaned = clean(raw, CleanUp(unit="mm"))  # doctest: +SKIP
>>> motion = cleaned.demonstrations  # doctest: +SKIP

The command line has the same as ``iflow-gym import``.
"""

from iflow_gym.recordings.cleaning import Cleaned, CleanUp, clean
from iflow_gym.recordings.columns import Columns
from iflow_gym.recordings.raw import RawRecording, RecordingError
from iflow_gym.recordings.reading import FORMATS, read_recordings
from iflow_gym.recordings.steps import Note

__all__ = [
    "FORMATS",
    "CleanUp",
    "Cleaned",
    "Columns",
    "Note",
    "RawRecording",
    "RecordingError",
    "clean",
    "read_recordings",
]
