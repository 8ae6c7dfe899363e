"""Makes the pictures of docs/drumming.md: `python docs/drumming.py`, half a minute.

docs/images/drumming.gif  a demonstration replayed by the arm, one round
docs/images/drumming.png  the demonstrations in space, and when which drum is hit
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from iflow_gym.datasets.drums import DRUMS
from iflow_gym.envs.drumming.env import DrummingEnv
from iflow_gym.figures import save_figure
from iflow_gym.metrics.drumming import FORCE_THRESHOLD
from iflow_gym.plotting import DEMONSTRATION, INK, ROLLOUT

IMAGES = Path(__file__).parent / "images"
SHOWN = 1
"""The demonstration of the moving picture."""
EVERY = 6
"""Control steps a frame of it: 60 ms, as the GIF's hundredths of a second allow."""
COLOURS = (DEMONSTRATION, "#2a6fb0")
"""Of the right and the left drum."""


def replayed(env: DrummingEnv, index: int) -> Iterator[dict]:
    """Replay a demonstration; yield each step's info."""
    path = env.demonstrations.positions[index]
    observation, _ = env.reset(options={"demonstration": index})
    for following in path[1:]:
        velocity = (following - observation) / env.dt
        observation, *_, info = env.step(env.command_to_action(velocity, observation))
        yield info


def moving() -> None:
    """Draw one round as a GIF."""
    env = DrummingEnv(render_mode="rgb_array", width=480, height=360)
    n_frames = round(env.demonstrations.period / (EVERY * env.dt))
    frames, struck = [], []
    for k, info in enumerate(replayed(env, SHOWN)):
        if k % EVERY == 0 and len(frames) < n_frames:
            frames.append(env.render())
            if info["forces"].max() >= FORCE_THRESHOLD:
                struck.append(frames[-1])
    env.close()
    # One palette for all frames, and no dither: what stands still then compresses to nothing. The
    # strokes count more, for the sake of their colour.
    sheet = Image.fromarray(np.concatenate([*frames[::12], *struck, *struck]))
    palette = sheet.quantize(128, kmeans=2)
    flat = [Image.fromarray(f).quantize(palette=palette, dither=0) for f in frames]
    flat[0].save(
        IMAGES / "drumming.gif",
        save_all=True,
        append_images=flat[1:],
        duration=10 * EVERY,
        loop=0,
        optimize=True,
    )


def still() -> None:
    """Draw the demonstrations in space, and the hits of their replays in time."""
    env = DrummingEnv()
    demos = env.demonstrations
    figure = Figure(figsize=(12, 4.6), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 2, width_ratios=(1, 1.35), height_ratios=(1.7, 1))
    space = figure.add_subplot(grid[:, 0], projection="3d")
    angle = np.linspace(0, 2 * np.pi, 80)
    for drum, colour in zip(DRUMS, COLOURS, strict=True):
        x, y, z = drum.head
        rim = np.stack([x + drum.radius * np.cos(angle), y + drum.radius * np.sin(angle)])
        space.plot(*rim, np.full(80, z), color=colour, linewidth=2)
        space.text(x + 0.02, y, z - 0.055, drum.name, color=colour, ha="center", fontsize=9)
    for path in demos.positions:
        space.plot(*path.T, color=INK, linewidth=0.9, alpha=0.7)
    space.plot(*demos.positions[SHOWN].T, color=ROLLOUT, linewidth=1.8)
    space.set_box_aspect((1.0, 1.6, 1.0))
    space.set(xlabel="x (m)", ylabel="y (m)", zlabel="z (m)", xticks=[0.6, 0.7, 0.8])
    space.view_init(elev=14, azim=-22)
    space.set_title("six demonstrations of the stick's tip", fontsize=10, color=INK)

    time = figure.add_subplot(grid[0, 1])
    force_axes = figure.add_subplot(grid[1, 1], sharex=time)
    for index in range(len(demos)):
        infos = list(replayed(env, index))
        for at, drum in zip(*env.score_of(index), strict=True):
            time.plot([at, at], [index + 0.62, index + 1.38], color=COLOURS[drum], linewidth=5,
                      alpha=0.3, solid_capstyle="butt")  # fmt: skip
        for hit in (h for info in infos for h in info["hits"]):
            time.plot(hit.time, index + 1, "o", color=COLOURS[hit.drum],
                      markersize=2 + 1.2 * np.sqrt(hit.force))  # fmt: skip
        if index == SHOWN:
            forces = np.array([info["forces"] for info in infos])
            for drum, colour in enumerate(COLOURS):
                force_axes.fill_between(
                    env.dt * np.arange(1, len(forces) + 1), forces[:, drum], color=colour,
                    linewidth=1.2, label=DRUMS[drum].name,
                )  # fmt: skip
    time.set(ylabel="demonstration", yticks=range(1, len(demos) + 1), xlim=(0, 10))
    time.invert_yaxis()
    time.set_title(
        "bars: the score that a demonstration implies; dots: hits of its replay", fontsize=10,
        color=INK,
    )  # fmt: skip
    time.tick_params(labelbottom=False)
    force_axes.axhline(FORCE_THRESHOLD, color=INK, linewidth=0.8, linestyle=":")
    force_axes.set(xlabel="time (s)", ylabel="force (N)", ylim=(0, None))
    force_axes.legend(title=f"demonstration {SHOWN + 1}", frameon=False, fontsize=8,
                      title_fontsize=8, loc="upper right")  # fmt: skip
    for ax in (time, force_axes):
        ax.spines[["top", "right"]].set_visible(False)
    save_figure(figure, IMAGES / "drumming.png", dpi=110)


def main() -> None:
    """Draw all."""
    moving()
    still()


if __name__ == "__main__":
    main()
