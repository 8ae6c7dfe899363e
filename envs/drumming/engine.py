"""MuJoCo, imported so that a missing OpenGL library keeps nobody from simulating.

MuJoCo loads the library that `MUJOCO_GL` names when it is imported, and cannot be imported where
that library is missing. Here it is then imported without: pictures fail with an error that says
what to install, and all else works.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import os
import sys
from typing import Any, Final

LIBRARIES: Final = {"egl": "EGL", "osmesa": "OSMesa"}
"""Name for `MUJOCO_GL` -> library, in the order in which they are tried."""


def has_library(backend: str) -> bool:
    """Whether the OpenGL library of a backend can be loaded."""
    path = ctypes.util.find_library(LIBRARIES[backend])
    if path is None:
        return False
    try:
        ctypes.CDLL(path)
    except OSError:
        return False
    return True


def _imported() -> Any:
    wanted = os.environ.get("MUJOCO_GL", "")
    backend = wanted.lower().strip()
    if "mujoco" in sys.modules or backend not in LIBRARIES or has_library(backend):
        import mujoco

        return mujoco
    os.environ["MUJOCO_GL"] = "disable"
    try:
        import mujoco
    finally:
        os.environ["MUJOCO_GL"] = wanted
    return mujoco


mujoco: Final = _imported()
