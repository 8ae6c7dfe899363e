"""iflow-gym: stable motions from demonstrations, learned, proved and scored.

Importing the package registers its environments with Gymnasium:

>>> import gymnasium
>>> import iflow_gym
>>> env = gymnasium.make("iflow/LASA-Angle-v0")
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from iflow_gym.demonstrations import Demonstrations
from iflow_gym.registration import register_all

if TYPE_CHECKING:
    from iflow_gym.datasets.lasa import load_lasa
    from iflow_gym.policy import DynamicalSystemPolicy, MovementPrimitivePolicy
    from iflow_gym.primitive import MovementPrimitive
    from iflow_gym.system import DynamicalSystem

__version__ = "0.1.0"

__all__ = [
    "Demonstrations",
    "DynamicalSystem",
    "DynamicalSystemPolicy",
    "MovementPrimitive",
    "MovementPrimitivePolicy",
    "__version__",
    "load_lasa",
]

_LAZY = {
    "DynamicalSystem": "iflow_gym.system",
    "DynamicalSystemPolicy": "iflow_gym.policy",
    "MovementPrimitive": "iflow_gym.primitive",
    "MovementPrimitivePolicy": "iflow_gym.policy",
    "load_lasa": "iflow_gym.datasets.lasa",
}
"""Names that are imported when they are first asked for, to keep `import iflow_gym` fast."""


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_LAZY[name]), name)


register_all()
