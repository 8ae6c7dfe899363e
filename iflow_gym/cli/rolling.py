"""``iflow-gym rollout``: trajectories of a model as CSV."""

from __future__ import annotations

import csv
import sys
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, UseAppendAction, arg

from iflow_gym.cli.console import (
    PIPE,
    UsageError,
    check_output,
    input_bytes,
    only_one_pipe,
    output_path,
    say,
)
from iflow_gym.recordings.columns import shown

if TYPE_CHECKING:
    from iflow_gym.demonstrations import FloatArray
    from iflow_gym.system import Method

MOST_ROWS = 10_000_000


@dataclass(frozen=True)
class Rollout:
    """Run a model from given starts, and write time, position and velocity as CSV.

    Starts are written x,y; those of the demonstrations are taken with --motion. A push displaces
    the state at a time. A negative start is written --start=-0.1,0.2.

        iflow-gym rollout policy.safetensors --start 0.3,0.1 --duration 3 --dt 0.01
        iflow-gym rollout policy.safetensors --motion reach.safetensors -o paths.csv
        iflow-gym rollout policy.safetensors --start 0.3,0.1 --push 0.5:0.05,0 --push 1:0,-0.05
        echo 0.3,0.1 | iflow-gym rollout policy.safetensors --starts - | head
    """

    model: Annotated[Positional[str], arg(metavar="MODEL")]
    """Model that `iflow-gym fit` wrote; - reads standard input."""
    start: Annotated[tuple[str, ...], UseAppendAction, shown("X,Y")] = ()
    """A start, x,y[,z]; may be given several times."""
    starts: Annotated[str | None, shown("FILE")] = None
    """CSV file of starts, one a line, with a heading or without; - reads standard input."""
    motion: Annotated[str | None, shown("MOTION")] = None
    """Demonstrations, or an environment, from whose starts to begin, and whose times to take."""
    dt: Annotated[float | None, shown("SECONDS")] = None
    """Seconds a step; by default the mean of the demonstrations'."""
    duration: Annotated[float | None, shown("SECONDS")] = None
    """Seconds of a rollout; by default the longest demonstration, or two rounds."""
    push: Annotated[tuple[str, ...], UseAppendAction, shown("T:DX,DY")] = ()
    """A displacement at a time in seconds, t:dx,dy[,dz]; may be given several times."""
    method: Annotated[str | None, shown("MODULE:CLASS")] = None
    """module:Class of a model whose method is one's own."""
    output: Annotated[str, arg(metavar="FILE", aliases=["-o"])] = PIPE
    """CSV file to write; - is standard output."""

    def run(self) -> int:
        """Roll out."""
        import numpy as np

        from iflow_gym.cli.motions import check_match, load_model_file, load_motion

        only_one_pipe(self.model, self.starts or "", self.motion or "")
        if self.output != PIPE:
            inputs = (self.model, self.starts or "", self.motion or "")
            check_output(self.output, *inputs, suffix=".csv")
        method, record = load_model_file(self.model, self.method)
        d = method.n_dims_
        starts = [_vector(text, d, "--start") for text in self.start]
        if self.starts is not None:
            starts += _starts_of(self.starts, d)
        dt, duration = self.dt, self.duration
        if self.motion is not None:
            demos, _ = load_motion(self.motion)
            check_match(method, record, demos)
            starts += [] if starts else list(demos.starts)
            dt = demos.mean_dt if dt is None else dt
            if duration is None:
                duration = (
                    float(demos.durations.max()) if demos.period is None else 2 * demos.period
                )
        if not starts:
            raise UsageError(
                "Expected starts (--start 0.3,0.1, --starts file.csv, or --motion), got none."
            )
        dt = _said(record, "mean_dt") if dt is None else dt
        if dt is None or not (np.isfinite(dt) and dt > 0):
            came = "none" if dt is None else dt
            raise UsageError(f"Expected a time step > 0 in seconds (--dt), got {came}.")
        if duration is None:
            period = method.period_
            duration = _said(record, "longest") if period is None else 2 * period
        if duration is None or not (np.isfinite(duration) and duration >= dt):
            raise UsageError(
                f"Expected a duration of at least one step of {dt:g} s (--duration, or --motion "
                f"for that of the demonstrations), got {'none' if duration is None else duration}."
            )
        pushes = sorted((_push(text, d) for text in self.push), key=lambda p: p[0])
        n_steps = round(duration / dt)
        if n_steps * len(starts) > MOST_ROWS:
            raise UsageError(
                f"Expected at most {MOST_ROWS} samples, got {len(starts)} rollouts of {n_steps}."
            )
        for time, _ in pushes:
            if not 0 <= time <= duration:
                raise UsageError(
                    f"Expected pushes from 0 to {duration:g} s, got one at {time:g} s."
                )
        times, paths, velocities = rolled(method, np.stack(starts), n_steps, dt, pushes)
        axes = ["x", "y", "z"][:d] if d <= 3 else [f"x{k + 1}" for k in range(d)]
        heading = ["start", "t", *axes, *(f"v{a}" for a in axes)]
        if self.output == PIPE:
            _write(sys.stdout, heading, times, paths, velocities)
            return 0
        with (
            output_path(self.output, ".csv") as path,
            path.open("w", newline="", encoding="utf-8") as file,
        ):
            _write(file, heading, times, paths, velocities)
        say(f"{len(starts)} rollouts of {n_steps} steps of {dt:g} s. Written to {self.output}.")
        return 0


def rolled(
    method: Method,
    starts: FloatArray,
    n_steps: int,
    dt: float,
    pushes: list[tuple[float, FloatArray]],
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return times (T,), paths (n, T, d) and velocities (n, T, d), T = n_steps + 1.

    A push comes at the first sample at or after its time: that sample is where the state has been
    pushed to. The clock of a method that uses time runs on. Velocities are the field's; of a method
    that has none, what takes a sample to the next before any push.
    """
    import numpy as np

    from iflow_gym.system import DynamicalSystem

    at: dict[int, FloatArray] = {}
    for time, push in pushes:
        k = int(np.ceil(time / dt - 1e-9))
        at[k] = at.get(k, np.zeros(starts.shape[1])) + push
    x = starts + at.get(0, 0.0)
    paths = np.empty((len(starts), n_steps + 1, starts.shape[1]))
    velocities = np.zeros_like(paths)
    paths[:, 0] = x
    if isinstance(method, DynamicalSystem):
        cuts = sorted({0, n_steps, *(k for k in at if 0 < k <= n_steps)})
        for begin, end in pairwise(cuts):
            paths[:, begin : end + 1] = method.rollout(x, end - begin, dt)
            x = paths[:, end] = paths[:, end] + at.get(end, 0.0)
        velocities = method.velocity(paths)
    else:
        primitive: Any = method
        state = primitive.begin(x)
        for k in range(n_steps):
            following, state = primitive.advance(x, state, dt)
            velocities[:, k] = (following - x) / dt
            x = following + at.get(k + 1, 0.0)
            paths[:, k + 1] = x
        following, _ = primitive.advance(x, state, dt)
        velocities[:, n_steps] = (following - x) / dt
    return np.arange(n_steps + 1, dtype=np.float64) * dt, paths, velocities


def _write(
    file: Any, heading: list[str], times: FloatArray, paths: FloatArray, velocities: FloatArray
) -> None:
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(heading)
    for i, (path, speeds) in enumerate(zip(paths.tolist(), velocities.tolist(), strict=True)):
        for t, x, v in zip(times.tolist(), path, speeds, strict=True):
            writer.writerow([i, f"{t:.9g}", *(f"{c:.9g}" for c in (*x, *v))])


def _said(record: dict[str, Any] | None, key: str) -> float | None:
    """Return the seconds that a model file says of what it was fitted on, if it does."""
    value = (record or {}).get(key)
    return value if isinstance(value, float) else None


def _vector(text: str, d: int, flag: str) -> FloatArray:
    import numpy as np

    try:
        values = np.array([float(part) for part in text.replace(",", " ").split()])
    except ValueError:
        values = np.empty(0)
    if values.shape != (d,) or not np.isfinite(values).all():
        raise UsageError(
            f"Expected {d} numbers in {flag}, as the model has dimensions, such as "
            f"{','.join(['0.1'] * d)}, got {text[:60]!r}."
        )
    return values


def _push(text: str, d: int) -> tuple[float, FloatArray]:
    time, colon, rest = text.partition(":")
    try:
        seconds = float(time)
    except ValueError:
        seconds = float("nan")
    if not colon or seconds != seconds:
        raise UsageError(f"Expected a push t:{','.join(['dx', 'dy', 'dz'][:d])}, got {text!r}.")
    return seconds, _vector(rest, d, "--push")


def _starts_of(path: str, d: int) -> list[FloatArray]:
    """Return the starts in a file, one a line."""
    if path != PIPE and (not Path(path).exists() or Path(path).is_dir()):
        came = "a folder" if Path(path).is_dir() else "none"
        raise UsageError(f"Expected a file of starts at {path}, got {came}.")
    text = (
        input_bytes().decode("utf-8", "replace")
        if path == PIPE
        else Path(path).read_text(encoding="utf-8", errors="replace")
    )
    lines = [line for line in text.splitlines() if line.strip() and line[:1] != "#"]
    if lines and any(c.isalpha() and c not in "eE" for c in lines[0]):
        lines = lines[1:]
    if not lines:
        raise UsageError(f"Expected starts in {path}, one a line, got none.")
    return [_vector(line.replace(";", ","), d, f"each line of {path}") for line in lines]
