"""A trained emission y = h(z) as plain NumPy: what every flow's fast path offers.

The same map as its torch twin with one model, in float64 and without autograd. Here the inverse is
exact to rounding, whatever precision training had.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from iflow_gym.demonstrations import FloatArray

ORTHOGONAL = 1e-6
"""How far R^T R of a rotation may be from the identity: its inverse is taken as R^T."""


class FlowConfig(Protocol):
    """What a flow needs of the method's settings."""

    @property
    def log_scale_bound(self) -> float:
        """The bound of a layer's log-scales."""


class FlowField(ABC):
    """A diffeomorphism h of R^d and its inverse, for states of shape (n, d).

    Parameters
    ----------
    arrays : mapping of str to array
        The parameters under `NAMES`; others are ignored.
    config : FlowConfig
        The settings that are no array.

    Raises
    ------
    KeyError, ValueError
        If an array is missing or is not what makes h a diffeomorphism.
    """

    NAMES: ClassVar[tuple[str, ...]]
    """The names of the flow's arrays."""
    n_dims: int
    arrays: dict[str, FloatArray]
    """Those under `NAMES`, in float64."""

    @abstractmethod
    def __init__(self, arrays: Mapping[str, NDArray[Any]], config: FlowConfig) -> None: ...

    @abstractmethod
    def forward(self, z: FloatArray) -> FloatArray:
        """Return y = h(z), both (n, d)."""

    @abstractmethod
    def inverse(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return z = h^-1(y), (n, d), and log |det dz/dy|, (n,)."""

    @abstractmethod
    def push_forward(self, z: FloatArray, dz: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return h(z) and the Jacobian-vector product J_h(z) dz, both (n, d)."""


def as_float(
    arrays: Mapping[str, NDArray[Any]], names: Sequence[str], n_axes: Sequence[int]
) -> list[FloatArray]:
    """Return the named arrays as contiguous finite float64 of at least one layer.

    Raises
    ------
    KeyError, ValueError
        If one is missing, has another number of axes, no layer, or a number that is not finite.
    """
    values = [np.ascontiguousarray(arrays[name], dtype=np.float64) for name in names]
    shapes = [v.shape for v in values]
    if [len(s) for s in shapes] != list(n_axes) or shapes[0][0] < 1:
        raise ValueError(
            f"expected {', '.join(names)} of at least one layer with {', '.join(map(str, n_axes))} "
            f"axes, got shapes {shapes}"
        )
    for name, value in zip(names, values, strict=True):
        if not np.isfinite(value).all():
            raise ValueError(f"expected finite numbers in {name}, got NaN or infinity")
    return values


def check_shapes(
    names: Sequence[str], values: Sequence[FloatArray], expected: Sequence[tuple[int, ...]]
) -> None:
    """Raise ValueError unless each array has its expected shape."""
    if (shapes := [v.shape for v in values]) != list(expected):
        raise ValueError(f"expected {', '.join(names)} of shapes {list(expected)}, got {shapes}")


def check_orthogonal(rotations: FloatArray) -> None:
    """Raise ValueError unless every matrix of rotations (layers, d, d) is orthogonal."""
    eye = np.eye(rotations.shape[-1])
    off = np.linalg.norm(np.swapaxes(rotations, -1, -2) @ rotations - eye, axis=(-2, -1)).max()
    if not off <= ORTHOGONAL:
        raise ValueError(f"expected orthogonal rotations, got |R^T R - I| = {off:.3g}")
