"""``iflow-gym export``: a model as ONNX, which runs without this package."""

from __future__ import annotations

import importlib.util
import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from iflow_gym.cli.console import PIPE, UsageError, check_output, output_path, say
from iflow_gym.recordings.columns import shown

if TYPE_CHECKING:
    from pathlib import Path

    from iflow_gym.system import Method

AGREE = 1e-9
"""ONNX Runtime's step is within this of the model's, of the size of what it is asked."""


@dataclass(frozen=True)
class Export:
    """Write a model as ONNX, check it against the model, and print the lines that run it.

    Needs the extra onnx: pip install 'iflow-gym[onnx]'. Where the policy runs, ONNX Runtime is
    enough. docs/real-time.md has what a step costs.

        iflow-gym export policy.safetensors -o policy.onnx
        iflow-gym export policy.safetensors -o policy.onnx --no-velocity > run.py
    """

    model: Annotated[Positional[str], arg(metavar="MODEL")]
    """Model that `iflow-gym fit` wrote; - reads standard input."""
    output: Annotated[str, arg(metavar="FILE", aliases=["-o"])]
    """File to write, such as policy.onnx."""
    velocity: bool = True
    """Whether the file has the output velocity, too; without it a step takes half the time."""
    method: Annotated[str | None, shown("MODULE:CLASS")] = None
    """module:Class of a model whose method is one's own."""

    def run(self) -> int:
        """Export."""
        from iflow_gym.cli.motions import load_model_file

        if self.output == PIPE:
            raise UsageError(
                "Expected a file to write, got standard output, where the snippet goes."
            )
        check_output(self.output, self.model, suffix=".onnx")
        method, record = load_model_file(self.model, self.method)
        export = getattr(method, "export", None)
        if export is None:
            raise UsageError(
                f"Expected a model of imitation-flow, which has an ONNX graph, got one of "
                f"{method.name}: run that in Python (iflow_gym.saved_models.load_model)."
            )
        with output_path(self.output, ".onnx") as path:
            export(path, velocity=self.velocity)
            _add_metadata(path, method, record)
            difference = _checked(method, path)
        said = ""
        if difference is not None:
            said = f" ONNX Runtime agrees with the model to {difference:.1g} of the states' size."
        say(f"{path.stat().st_size / 1024:.0f} KiB written to {self.output}.{said}")
        if difference is None:
            say("It was not checked, because onnxruntime is not installed here.")
        print(snippet(method, self.output, self.velocity, record))
        return 0


def snippet(method: Method, path: str, velocity: bool, record: dict[str, Any] | None) -> str:
    """Return the lines of Python that run an exported model, from a start that was recorded."""
    beside = [float(g) + 0.1 * max(abs(float(g)), 1.0) for g in method.goal_]
    said = (record or {}).get("start")
    known = isinstance(said, list) and len(said) == len(beside)
    start = [round(float(c), 6) for c in (said if known else beside)]  # type: ignore[union-attr]
    dt = (record or {}).get("mean_dt")
    unit = (record or {}).get("length_unit")
    dt = dt if isinstance(dt, float) else 0.01
    unit = unit if isinstance(unit, str) and unit.isprintable() else "the recordings' unit"
    names = ["x_next", "velocity"] if velocity else ["x_next"]
    outputs = ", ".join(names) + ("" if velocity else ",")
    command = "velocity[0]" if velocity else "(x_next - x)[0] / dt"
    return f"""\
import numpy as np
import onnxruntime

options = onnxruntime.SessionOptions()
options.intra_op_num_threads = 1
session = onnxruntime.InferenceSession({path!r}, options)
dt = {dt:.6g}  # seconds; any step is exact
x = np.array([{start}])  # where you are, in {unit}; several rows are several states
for _ in range(500):
    {outputs} = session.run({names}, {{"x": x, "dt": np.array([dt])}})
    command = {command}  # what a velocity controller takes
    x = x_next  # in a loop with a robot: what it measures
print(x[0])"""


def _add_metadata(path: Path, method: Method, record: dict[str, Any] | None) -> None:
    """Put into a file what a controller asks for: unit of length, sample time, goal or period."""
    import onnx

    said: dict[str, Any] = {
        "length_unit": (record or {}).get("length_unit"),
        "sample_time": (record or {}).get("mean_dt"),
        "goal": method.goal_.tolist() if method.period_ is None else None,
        "period": method.period_,
    }
    model = onnx.load(path)
    for key, value in said.items():
        if value is not None:
            model.metadata_props.add(key=key, value=json.dumps(value))
    partial = path.with_name(f"{path.name}.partial")
    partial.write_bytes(model.SerializeToString())
    partial.replace(path)


def _checked(method: Any, path: Path) -> float | None:
    """Return how far ONNX Runtime's step is from the model's at most, of the states' size.

    None without ONNX Runtime; raises RuntimeError where they differ.
    """
    if importlib.util.find_spec("onnxruntime") is None:
        return None
    import numpy as np
    import onnxruntime

    session = onnxruntime.InferenceSession(str(path))
    size = max(float(np.abs(method.goal_).max()), 1.0)
    states = method.goal_ + size * np.random.default_rng(0).uniform(-0.5, 0.5, (20, method.n_dims_))
    (there,) = session.run(["x_next"], {"x": states, "dt": np.array([0.01])})
    difference = float(np.abs(there - method.step(states, 0.01)).max()) / size
    if not difference <= AGREE:
        path.unlink()
        raise ValueError(
            f"Expected ONNX Runtime to agree with the model to {AGREE:g}, got a difference of "
            f"{difference:.3g} of the states' size: the file was removed."
        )
    return difference
