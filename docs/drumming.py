"""Makes the pictures and the sound of docs/drumming.md: `python docs/drumming.py`, a minute.

docs/images/drumming.gif          a demonstration replayed by the arm, one round
docs/images/drumming.png          the demonstrations in space, and when which drum is hit
docs/images/drumming-learned.gif  ImitationFlow drums, one round after two others
docs/images/drumming-learned.png  its path among the demonstrations, and when it hits which drum
docs/images/drumming-in-time.png  when it hits which drum by itself, and when it is given a score
docs/sounds/drumming-learned.wav  what the round of drumming-learned.gif sounds like

ImitationFlow is the leaderboard's model of seed 0.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from iflow_gym import DynamicalSystemPolicy
from iflow_gym.baselines.imitation_flow import ImitationFlow
from iflow_gym.baselines.imitation_flow.in_time import InTimePolicy, rehearsed
from iflow_gym.datasets.drums import DRUMS, load_drums
from iflow_gym.envs.drumming.control import CONTROL_DT
from iflow_gym.envs.drumming.env import DrummingEnv
from iflow_gym.envs.drumming.sound import write_sound
from iflow_gym.figures import save_figure
from iflow_gym.metrics.drumming import FORCE_THRESHOLD, Hit, rhythm
from iflow_gym.plotting import DEMONSTRATION, INK, ROLLOUT

IMAGES = Path(__file__).parent / "images"
SOUNDS = Path(__file__).parent / "sounds"
MODEL = (
    Path(__file__).resolve().parents[1]
    / "leaderboard/results/imitation-flow/Drumming-v0.reproduction.seed0.safetensors"
)
SHOWN = 1
"""The demonstration of the moving picture."""
EVERY = 6
"""Control steps a frame of it: 60 ms, as the GIF's hundredths of a second allow."""
ROUNDS = 4
"""Of what is learned, in the still picture."""
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


def played(env: DrummingEnv, policy: Any, index: int) -> Iterator[dict]:
    """Let a policy drum from a demonstration's start; yield each step's info, and the tip in it."""
    observation, _ = env.reset(options={"demonstration": index})
    truncated, state = False, None
    while not truncated:
        action, state = policy.predict(observation, state)
        observation, _, _, truncated, info = env.step(action)
        yield info | {"tip": observation}


def moving(env: DrummingEnv, infos: Iterator[dict], name: str, begin: int = 0) -> list[Hit]:
    """Draw one round from a step on as a GIF; return its hits, in its own time."""
    n_frames = round(env.demonstrations.period / (EVERY * env.dt))
    frames, struck, hits = [], [], []
    for k, info in enumerate(infos):
        if k >= begin and k % EVERY == 0 and len(frames) < n_frames:
            frames.append(env.render())
            if info["forces"].max() >= FORCE_THRESHOLD:
                struck.append(frames[-1])
        hits += [hit._replace(time=hit.time - begin * env.dt) for hit in info["hits"]]
    # One palette for all frames, and no dither: what stands still then compresses to nothing. The
    # strokes count more, for the sake of their colour.
    sheet = Image.fromarray(np.concatenate([*frames[::12], *struck, *struck]))
    palette = sheet.quantize(128, kmeans=2)
    flat = [Image.fromarray(f).quantize(palette=palette, dither=0) for f in frames]
    flat[0].save(
        IMAGES / name,
        save_all=True,
        append_images=flat[1:],
        duration=10 * EVERY,
        loop=0,
        optimize=True,
    )
    return [hit for hit in hits if 0 <= hit.time < n_frames * EVERY * env.dt]


def drawing() -> tuple[Figure, Any, Any, Any]:
    """Return a figure, its axes in space with the drums, and those of hits and of forces."""
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
    space.set_box_aspect((1.0, 1.6, 1.0))
    space.set(xlabel="x (m)", ylabel="y (m)", zlabel="z (m)", xticks=[0.6, 0.7, 0.8])
    space.view_init(elev=14, azim=-22)
    time = figure.add_subplot(grid[0, 1])
    force = figure.add_subplot(grid[1, 1], sharex=time)
    time.tick_params(labelbottom=False)
    force.axhline(FORCE_THRESHOLD, color=INK, linewidth=0.8, linestyle=":")
    for ax in (time, force):
        ax.spines[["top", "right"]].set_visible(False)
    return figure, space, time, force


def row_of_hits(time: Any, row: int, notes: Any, infos: list[dict]) -> None:
    """Draw notes, times and drums, as bars and the hits as dots."""
    for at, drum in zip(*notes, strict=True):
        time.plot([at, at], [row + 0.62, row + 1.38], color=COLOURS[drum], linewidth=5,
                  alpha=0.3, solid_capstyle="butt")  # fmt: skip
    for hit in (h for info in infos for h in info["hits"]):
        time.plot(hit.time, row + 1, "o", color=COLOURS[hit.drum],
                  markersize=2 + 1.2 * np.sqrt(hit.force))  # fmt: skip


def forces_of(force: Any, infos: list[dict], dt: float, title: str) -> None:
    """Draw the forces on the heads over time."""
    forces = np.array([info["forces"] for info in infos])
    for drum, colour in enumerate(COLOURS):
        force.fill_between(dt * np.arange(1, len(forces) + 1), forces[:, drum], color=colour,
                           linewidth=1.2, label=DRUMS[drum].name)  # fmt: skip
    force.set(xlabel="time (s)", ylabel="force (N)", ylim=(0, 1.6 * forces.max()))
    force.legend(
        title=title, frameon=False, fontsize=8, title_fontsize=8, loc="upper right", ncols=2
    )


def still() -> None:
    """Draw the demonstrations in space, and the hits of their replays in time."""
    env = DrummingEnv()
    demos = env.demonstrations
    figure, space, time, force = drawing()
    for path in demos.positions:
        space.plot(*path.T, color=INK, linewidth=0.9, alpha=0.7)
    space.plot(*demos.positions[SHOWN].T, color=ROLLOUT, linewidth=1.8)
    space.set_title("six demonstrations of the stick's tip", fontsize=10, color=INK)
    for index in range(len(demos)):
        infos = list(replayed(env, index))
        row_of_hits(time, index, env.score_of(index), infos)
        if index == SHOWN:
            forces_of(force, infos, env.dt, f"demonstration {SHOWN + 1}")
    time.set(ylabel="demonstration", yticks=range(1, len(demos) + 1), xlim=(0, 10))
    time.invert_yaxis()
    time.set_title(
        "bars: the score that a demonstration implies; dots: hits of its replay", fontsize=10,
        color=INK,
    )  # fmt: skip
    save_figure(figure, IMAGES / "drumming.png", dpi=110)


def learned(system: ImitationFlow) -> None:
    """Draw a system's path among the demonstrations, and its hits in time."""
    n_steps = round(ROUNDS * load_drums().period / CONTROL_DT)
    env = DrummingEnv(horizon=n_steps)
    demos = env.demonstrations
    phases = rhythm([env.score_of(index) for index in range(len(demos))])
    figure, space, time, force = drawing()
    for path in demos.positions:
        space.plot(*path.T, color=INK, linewidth=0.9, alpha=0.5)
    for index in range(len(demos)):
        infos = list(played(env, DynamicalSystemPolicy(system, env), index))
        hits = sorted(hit for info in infos for hit in info["hits"])
        tempo = np.median(np.diff([hit.time for hit in hits if hit.drum == 0]))
        first = next(hit.time for hit in hits if hit.drum == 0)
        rounds = np.arange(-1, ROUNDS + 1)[:, None]
        at = (first + (rounds + phases) * tempo).ravel()
        drums = np.tile(np.arange(len(DRUMS)), len(rounds))
        kept = (at > 0) & (at < n_steps * env.dt)
        row_of_hits(time, index, (at[kept], drums[kept]), infos)
        if index == SHOWN:
            space.plot(*np.array([i["tip"] for i in infos]).T, color=ROLLOUT, linewidth=1.8)
            forces_of(force, infos, env.dt, f"from start {SHOWN + 1}")
    space.set_title(
        f"demonstrations, and {ROUNDS} rounds of ImitationFlow (coloured)", fontsize=10, color=INK
    )
    time.set(ylabel="from the start of", yticks=range(1, len(demos) + 1), xlim=(0, None))
    time.invert_yaxis()
    time.set_title(
        "bars: the demonstrations' common rhythm, at its tempo and from its first right hit on;\n"
        "dots: its hits", fontsize=10, color=INK,
    )  # fmt: skip
    save_figure(figure, IMAGES / "drumming-learned.png", dpi=110)


def in_time(system: ImitationFlow) -> None:
    """Draw the hits of a system by itself, and given each demonstration's score."""
    env = DrummingEnv()
    phases = rehearsed(system, env)
    figure = Figure(figsize=(9, 5.2), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    above, below = figure.subplots(2, 1, sharex=True, sharey=True)
    for index in range(len(env.demonstrations)):
        notes = env.score_of(index)
        alone = DynamicalSystemPolicy(system, env)
        row_of_hits(above, index, notes, list(played(env, alone, index)))
        given = InTimePolicy(system, [notes], phases, env)
        row_of_hits(below, index, notes, list(played(env, given, index)))
    titles = ("by itself, from the start of each demonstration", "given the demonstration's score")
    for time, title in zip((above, below), titles, strict=True):
        time.set_title(title, fontsize=10, color=INK)
        time.set(ylabel="demonstration", yticks=range(1, len(env.demonstrations) + 1))
        time.spines[["top", "right"]].set_visible(False)
    below.set(xlabel="time (s); bars are the notes of a demonstration, dots are hits", xlim=(0, 10))
    below.invert_yaxis()
    save_figure(figure, IMAGES / "drumming-in-time.png", dpi=110)


def main() -> None:
    """Draw all."""
    size = {"render_mode": "rgb_array", "width": 480, "height": 360}
    env = DrummingEnv(**size)
    moving(env, replayed(env, SHOWN), "drumming.gif")
    env.close()
    still()
    system = ImitationFlow.load(MODEL)
    learned(system)
    in_time(system)
    turn = round(load_drums().period / CONTROL_DT)
    env = DrummingEnv(horizon=3 * turn + EVERY, **size)
    policy = DynamicalSystemPolicy(system, env)
    hits = moving(env, played(env, policy, SHOWN), "drumming-learned.gif", begin=2 * turn)
    env.close()
    write_sound(SOUNDS / "drumming-learned.wav", hits, seconds=turn * env.dt)


if __name__ == "__main__":
    main()
