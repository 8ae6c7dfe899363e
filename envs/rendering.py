"""Pictures of a running planar environment, through matplotlib and without OpenGL.

All that stays in place (streamlines, demonstrations, goal) is drawn once and kept as a bitmap; a
frame restores it and draws the trail and the mass, which takes a few milliseconds.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, cast

import gymnasium
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from iflow_gym.demonstrations import FloatArray
from iflow_gym.plotting import INK, PAPER, ROLLOUT, Field, plot_field

if TYPE_CHECKING:
    from iflow_gym.envs.point_mass import PointMassEnv

SIZE, DPI = 600, 100
"""Pixels a side of a frame, and pixels an inch."""

WINDOW_FPS = 30
"""Frames a second in a window; steps between them are not drawn."""


class Renderer:
    """Draws frames of one environment; made at its first `render()`."""

    def __init__(self, env: PointMassEnv) -> None:
        demos = env.demonstrations
        self._figure = Figure(figsize=(SIZE / DPI, SIZE / DPI), dpi=DPI, facecolor="white")
        self._canvas = cast("Any", FigureCanvasAgg(self._figure))  # its methods are not typed
        ax = self._figure.add_axes((0.105, 0.09, 0.875, 0.86))
        ax.set_title(f"{demos.name} · {env.control_mode}", color=INK, fontsize=10, loc="left")
        plot_field(ax, _Streamlines(env) if env.policy is not None else None, demos)
        self._canvas.draw()
        self._background = self._canvas.copy_from_bbox(self._figure.bbox)
        self._trail = ax.plot([], [], color=ROLLOUT, linewidth=2.4, solid_capstyle="round")[0]
        self._mass = ax.plot(
            [], [], "o", color=ROLLOUT, markersize=11, markeredgecolor=PAPER, markeredgewidth=1.6
        )[0]
        self._clock = ax.text(
            0.985, 1.017, "", transform=ax.transAxes, ha="right", color=INK, fontsize=10
        )
        self._ax = ax
        self._window: Any = None
        self._next_draw = 0.0
        self._ahead = 0.0

    def frame(self, trail: list[list[float]], seconds: float) -> NDArray[np.uint8]:
        """Return a picture, shape (SIZE, SIZE, 3), of a trail that ends where the mass is."""
        path = np.array(trail)
        self._trail.set_data(path[:, 0], path[:, 1])
        self._mass.set_data(path[-1:, 0], path[-1:, 1])
        self._clock.set_text(f"{seconds:.2f} s")
        self._canvas.restore_region(self._background)
        for artist in (self._trail, self._mass, self._clock):
            self._ax.draw_artist(artist)
        return np.array(np.asarray(self._canvas.buffer_rgba())[..., :3])

    def show(self, trail: list[list[float]], seconds: float) -> None:
        """Draw into a window when the next frame is due, at the pace of the recording."""
        now = time.monotonic()
        if len(trail) == 1:
            self._ahead, self._next_draw = now, now
        if now < self._next_draw and seconds < self._next_draw - self._ahead:
            return
        self._next_draw = max(now, self._ahead + seconds) + 1 / WINDOW_FPS
        picture = self.frame(trail, seconds)
        if self._window is None:
            self._window = _open_window(picture)
        figure, image, interactive = self._window
        image.set_data(picture)
        if interactive:
            figure.canvas.draw_idle()
            figure.canvas.flush_events()
            time.sleep(max(0.0, self._ahead + seconds - time.monotonic()))

    def close(self) -> None:
        """Close the window, where there is one."""
        if self._window is not None:
            from matplotlib import pyplot

            pyplot.close(self._window[0])
            self._window = None


class _Streamlines:
    """The field that an environment's `policy` commands."""

    def __init__(self, env: PointMassEnv) -> None:
        policy = env.policy
        if hasattr(policy, "velocity"):
            self.velocity: Field = policy.velocity
        elif hasattr(policy, "predict") and env.control_mode == "velocity":
            self.velocity = lambda x: _commanded(env, x)
        else:
            raise TypeError(
                "Expected policy to have velocity(x), or in velocity mode predict(observation), "
                f"got {type(policy).__name__}."
            )


def _commanded(env: PointMassEnv, x: FloatArray) -> FloatArray:
    actions, _ = env.policy.predict(x, deterministic=True)
    return env.action_to_velocity(actions)


def _open_window(picture: NDArray[np.uint8]) -> tuple[Any, Any, bool]:
    """Return a window's figure, its image, and whether anybody can see it."""
    from matplotlib import pyplot
    from matplotlib.backend_bases import FigureManagerBase

    figure = pyplot.figure(figsize=(SIZE / DPI, SIZE / DPI), dpi=DPI)
    ax = figure.add_axes((0, 0, 1, 1))
    ax.set_axis_off()
    image = ax.imshow(picture)
    manager = figure.canvas.manager
    # A backend that can show figures has a manager with its own show().
    interactive = manager is not None and type(manager).show is not FigureManagerBase.show
    if interactive:
        figure.show()
    else:
        gymnasium.logger.warn(
            f"render_mode='human' needs a display, got matplotlib's {pyplot.get_backend()!r} "
            "backend: use render_mode='rgb_array', or run where matplotlib can open a window."
        )
    return figure, image, interactive
