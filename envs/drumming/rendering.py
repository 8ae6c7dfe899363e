"""Pictures of the arm at work: MuJoCo's renderer without a window, on EGL or OSMesa."""

from __future__ import annotations

import atexit
import importlib
import os
import weakref
from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise
from typing import Any, Final

import numpy as np
from gymnasium.error import DependencyNotInstalled
from numpy.typing import NDArray

from iflow_gym.datasets.drums import Drum
from iflow_gym.demonstrations import FloatArray
from iflow_gym.envs.drumming.engine import LIBRARIES, has_library, mujoco
from iflow_gym.envs.drumming.scene import drawn_model, head_geoms
from iflow_gym.metrics.drumming import FORCE_THRESHOLD

INSTALL: Final = (
    "Rendering needs OpenGL without a window: install libegl1 (with a GPU, or Mesa's software "
    "renderer libegl-mesa0) or libosmesa6 (software), and set MUJOCO_GL=egl or MUJOCO_GL=osmesa "
    "before Python starts. Everything but pictures works without."
)

TRAIL: Final = 60
"""Samples of the tip's way that a picture shows: 0.6 s."""
STRUCK: Final = FORCE_THRESHOLD
STRUCK_COLOUR: Final = (0.95, 0.71, 0.02)
TRAIL_COLOUR: Final = (0.10, 0.45, 0.75)


def open_context(model: Any, width: int, height: int) -> tuple[Any, Any]:
    """Return an OpenGL context without a window, made current, and MuJoCo's own in it.

    `MUJOCO_GL` chooses; where it is not set, EGL is taken if its library is there, else OSMesa.

    Raises
    ------
    gymnasium.error.DependencyNotInstalled
        If there is no OpenGL, with what to install.
    """
    wanted = os.environ.get("MUJOCO_GL", "").lower().strip()
    if wanted in ("", "on", "enable", "1", "true"):
        found = [backend for backend in LIBRARIES if has_library(backend)]
        if not found:
            raise DependencyNotInstalled(INSTALL)
        wanted = found[0]
    if wanted not in (*LIBRARIES, "glfw", "glx"):
        raise DependencyNotInstalled(f"MUJOCO_GL={wanted!r} does not render. {INSTALL}")
    name = wanted if wanted in LIBRARIES else "glfw"
    try:
        gl = importlib.import_module(f"mujoco.{name}").GLContext(width, height)
        gl.make_current()
        context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
    except Exception as error:  # PyOpenGL raises whatever is at hand
        raise DependencyNotInstalled(
            f"OpenGL by {wanted} could not be used ({type(error).__name__}: {error}). {INSTALL}"
        ) from error
    return gl, context


_drawn = lru_cache(maxsize=8)(drawn_model)


class Renderer:
    """Draws the arm at its drums, and the tip's way, as the camera called "front" sees it."""

    def __init__(self, drums: tuple[Drum, ...], width: int, height: int) -> None:
        model = _drawn(drums)
        limits = model.vis.global_
        if not (0 < width <= limits.offwidth and 0 < height <= limits.offheight):
            raise ValueError(
                f"Expected a picture of at most {limits.offwidth} x {limits.offheight} pixels, got "
                f"{width} x {height}."
            )
        self._model, self._data = model, mujoco.MjData(model)
        self._heads = head_geoms(model, drums)
        self._gl, self._context = open_context(model, width, height)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._scene = mujoco.MjvScene(model, maxgeom=1000)
        self._options = mujoco.MjvOption()
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._camera.fixedcamid = model.camera("front").id
        self._rect = mujoco.MjrRect(0, 0, width, height)
        self._pixels = np.empty((height, width, 3), dtype=np.uint8)
        # At the interpreter's end too, and then before MuJoCo's own end of EGL: it was registered
        # when the context was opened, and what is registered later runs before.
        self._free = weakref.finalize(self, _free, self._gl, self._context)
        self._free.atexit = False
        atexit.register(self._free)

    def frame(
        self, posture: FloatArray, trail: Sequence[FloatArray] = (), forces: Sequence[float] = ()
    ) -> NDArray[np.uint8]:
        """Return a picture, shape (height, width, 3).

        Parameters
        ----------
        posture : array, shape (7,)
            Joint angles in rad.
        trail : sequence of arrays, shape (3,)
            Where the tip was, in m; the last `TRAIL` are drawn.
        forces : sequence of float
            On each head in N: one that is hit is coloured.
        """
        self._data.qpos[:] = posture
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        self._gl.make_current()
        mujoco.mjv_updateScene(
            self._model, self._data, self._options, None, self._camera,
            mujoco.mjtCatBit.mjCAT_ALL.value, self._scene,
        )  # fmt: skip
        struck = {g for g, i in self._heads.items() if i < len(forces) and forces[i] >= STRUCK}
        for geom in self._scene.geoms[: self._scene.ngeom] if struck else ():
            if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and geom.objid in struck:
                geom.rgba[:] = (*STRUCK_COLOUR, 1.0)
        recent = list(trail[-TRAIL:])
        for age, (begin, end) in enumerate(pairwise(recent)):
            self._add_line(begin, end, (age + 1) / len(recent))
        mujoco.mjr_render(self._rect, self._scene, self._context)
        mujoco.mjr_readPixels(self._pixels, None, self._rect, self._context)
        return np.flipud(self._pixels).copy()

    def _add_line(self, begin: FloatArray, end: FloatArray, opacity: float) -> None:
        scene = self._scene
        if scene.ngeom >= scene.maxgeom:
            return
        geom = scene.geoms[scene.ngeom]
        kind = mujoco.mjtGeom.mjGEOM_CAPSULE
        colour = np.array([*TRAIL_COLOUR, 0.9 * opacity], dtype=np.float32)
        mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.eye(3).ravel(), colour)
        mujoco.mjv_connector(geom, kind, 0.0025, begin, end)
        scene.ngeom += 1

    def close(self) -> None:
        """Free what OpenGL holds."""
        self._free()
        atexit.unregister(self._free)


def _free(gl: Any, context: Any) -> None:
    gl.make_current()
    context.free()
    gl.free()
