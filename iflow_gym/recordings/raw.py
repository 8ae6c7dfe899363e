"""A recording as it came from a file, before anything is done to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from iflow_gym.demonstrations import FloatArray

MOST_BYTES = 512 * 2**20
"""Files, and what they unpack to, may have this many bytes: what claims more is no recording of a
motion, and would fill the memory."""

LEAST_SAMPLES = 5
"""Of a recording that is cleaned: what has fewer shows no motion."""


class RecordingError(ValueError):
    """A recording, or a file of recordings, is not what it should be."""


@dataclass(frozen=True, eq=False)
class RawRecording:
    """One recording of n samples in d dimensions; nan stands for what is missing."""

    name: str
    """Where it came from, in words: ``"reach.csv, demo 2"``."""
    times: FloatArray
    """Time stamps, shape (n,), in seconds."""
    positions: FloatArray
    """Shape (n, d)."""
    velocities: FloatArray | None = None
    """Recorded velocities, shape (n, d); None where there are none."""

    def __post_init__(self) -> None:
        if self.positions.ndim != 2 or self.positions.shape[1] == 0:
            raise RecordingError(
                f"Expected positions of shape (samples, dimensions) in {self.name}, got "
                f"{self.positions.shape}."
            )
        if self.times.shape != (n := len(self.positions),):
            raise RecordingError(
                f"Expected {n} time stamps in {self.name}, got shape {self.times.shape}."
            )
        if self.velocities is not None and self.velocities.shape != self.positions.shape:
            raise RecordingError(
                f"Expected velocities of shape {self.positions.shape} in {self.name}, got "
                f"{self.velocities.shape}: leave them out to have them estimated."
            )

    def __len__(self) -> int:
        return len(self.times)

    @property
    def n_dims(self) -> int:
        """Dimension d of a sample."""
        return int(self.positions.shape[1])

    @property
    def whole(self) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Which samples lack nothing, shape (n,)."""
        rows = np.isfinite(self.times) & np.isfinite(self.positions).all(axis=1)
        if self.velocities is not None:
            rows &= np.isfinite(self.velocities).all(axis=1)
        return np.asarray(rows)

    @property
    def diagonal(self) -> float:
        """Length of the diagonal of the box around the samples that are there."""
        there = self.positions[np.isfinite(self.positions).all(axis=1)]
        return float(np.linalg.norm(np.ptp(there, axis=0))) if len(there) else 0.0

    def take(self, rows: np.ndarray[tuple[int], np.dtype[np.bool_]] | slice) -> RawRecording:
        """Return the samples of a mask or a slice."""
        speeds = None if self.velocities is None else self.velocities[rows]
        return RawRecording(self.name, self.times[rows], self.positions[rows], speeds)
