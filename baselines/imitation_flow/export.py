"""The mean dynamics of a trained model as an ONNX file, which runs without this package.

    import numpy as np, onnxruntime

    session = onnxruntime.InferenceSession("angle.onnx")
    (x_next,) = session.run(["x_next"], {"x": np.zeros((1, 2)), "dt": np.array([0.01])})
    (velocity,) = session.run(["velocity"], {"x": np.zeros((1, 2)), "dt": np.array([0.01])})

Inputs are ``x`` (n, d) and ``dt`` (n,) or (1,) > 0, in seconds; outputs are ``x_next`` (n, d),
exact for any dt, and ``velocity`` (n, d), which does not depend on dt. All are float64. ONNX
Runtime computes both whichever is asked for, so a control loop that only steps takes a file without
the velocity.

ONNX and not TorchScript, both measured by ``benchmarks/real_time.py``. For 24 layers of 16 units in
the plane, on one thread of an AMD EPYC, a step in ONNX Runtime takes 0.27 ms for one state and 3.9
ms for 1000; traced and frozen TorchScript takes 0.66 and 9 ms. The files have 33 and 57 KiB. ONNX
Runtime is 80 MB installed and torch 750, and torch deprecates TorchScript. Where this package is
installed, `realtime` and the batch are faster than either.

Inside, states are columns, as in `fields`; the flows' layers are in `graphs`. exp(A t) is closed in
the plane, and else a Taylor series with scaling and squaring for each dt, which needs no
eigenvectors of A: A may be defective.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from iflow_gym.baselines.imitation_flow.fields.autoregressive import AutoregressiveField
from iflow_gym.baselines.imitation_flow.fields.base import FlowField
from iflow_gym.baselines.imitation_flow.fields.coupling import CouplingField
from iflow_gym.baselines.imitation_flow.fields.spline import SplineField
from iflow_gym.baselines.imitation_flow.graphs import autoregressive, coupling, spline
from iflow_gym.baselines.imitation_flow.onnx_graph import Graph
from iflow_gym.baselines.imitation_flow.realtime import MeanDynamics
from iflow_gym.demonstrations import FloatArray

FORMAT_VERSION = 1
"""Version of the exported file: its inputs, outputs and metadata."""

LAYERS: dict[type[FlowField], Any] = {
    CouplingField: coupling,
    AutoregressiveField: autoregressive,
    SplineField: spline,
}
"""The module of each flow's graph, with `inverse` and `forward`."""

TAYLOR_ORDER = 13
"""With a norm of at most 1/2 the rest of the series is below 1e-15."""


def export(
    dynamics: MeanDynamics,
    path: str | os.PathLike[str],
    *,
    velocity: bool = True,
    **metadata: object,
) -> Path:
    """Write the mean dynamics as ONNX; replace atomically.

    Parameters
    ----------
    dynamics : MeanDynamics
        With a linear latent system or a limit cycle.
    path : path
        Of the file.
    velocity : bool
        Whether the file has the output ``velocity``; without it a step takes half the time.
    **metadata
        What should stand in the file beside ``format_version`` and ``n_dims``, as JSON: the units,
        the sample time of the demonstrations, the guarantee's words.

    Raises
    ------
    ImportError
        Without the extra ``onnx``.
    TypeError
        For a flow or a latent system that has no graph here.
    """
    flow, d = dynamics.flow, dynamics.flow.n_dims
    if type(flow) not in LAYERS:
        raise TypeError(
            "Expected a flow of coupling, autoregressive or spline layers to export, got "
            f"{type(flow).__name__}."
        )
    layers = LAYERS[type(flow)]
    graph = Graph()
    inverse_frame = np.linalg.inv(dynamics.frame)
    attractor, origin = dynamics.attractor.reshape(d, 1), dynamics.origin.reshape(d, 1)
    shifted = graph("Sub", graph("Transpose", "x", perm=[1, 0]), origin)
    encoded = layers.inverse(graph, flow, graph("MatMul", inverse_frame, shifted))
    z = graph("Sub", encoded, attractor)

    time = graph("Div", "dt", np.array(dynamics.time))
    advanced = graph("Add", _propagate(graph, dynamics.latent, z, time, d), attractor)
    y, _ = layers.forward(graph, flow, advanced, None)
    x_next = graph("Add", graph("MatMul", dynamics.frame, y), origin)
    graph("Transpose", x_next, perm=[1, 0], output="x_next")

    outputs = ["x_next"]
    if velocity:
        _, rate = layers.forward(graph, flow, encoded, _rate(graph, dynamics.latent, z, d))
        rate = graph("MatMul", dynamics.frame / dynamics.time, rate)
        outputs.append(graph("Transpose", rate, perm=[1, 0], output="velocity"))

    about = {"format_version": FORMAT_VERSION, "n_dims": d, **metadata}
    content = graph.serialised(
        inputs={"x": ("n", d), "dt": ("n or 1",)},
        outputs=dict.fromkeys(outputs, ("n", d)),
        metadata={key: json.dumps(value) for key, value in about.items()},
    )
    target = Path(path)
    partial = target.with_name(f"{target.name}.{os.getpid()}.partial")
    partial.write_bytes(content)
    partial.replace(target)
    return target


# The latent system ----------------------------------------------------------------------------


def _propagate(graph: Graph, latent: Any, z: str, time: str, d: int) -> str:
    if (drift := getattr(latent, "drift", None)) is not None:
        exponential = _planar_exponential if d == 2 else _exponential
        return exponential(graph, drift, z, time)
    if not hasattr(latent, "turn"):
        raise TypeError(
            "Expected a linear latent system or a limit cycle to export, got "
            f"{type(latent).__name__}."
        )
    x, y, rho, others = _polar(graph, z, d)
    decays = graph("Exp", graph("Mul", -latent.decay.reshape(-1, 1), time))
    kept, *rest = graph.split(decays, [1, d - 2] if d > 2 else [1])
    away = graph("Mul", graph("Sub", rho, np.array(latent.radius)), kept)
    rho = graph("Add", away, np.array(latent.radius))
    angle = graph("Mul", time, np.array(latent.turn))
    cos, sin = graph("Cos", angle), graph("Sin", angle)
    rows = [
        graph("Mul", rho, graph("Sub", graph("Mul", x, cos), graph("Mul", y, sin))),
        graph("Mul", rho, graph("Add", graph("Mul", x, sin), graph("Mul", y, cos))),
        *[graph("Mul", other, decay) for other, decay in zip(others, rest, strict=True)],
    ]
    return graph("Concat", *rows, axis=0)


def _rate(graph: Graph, latent: Any, z: str, d: int) -> str:
    if (drift := getattr(latent, "drift", None)) is not None:
        return graph("MatMul", drift, z)
    x, y, rho, others = _polar(graph, z, d)
    away = graph("Sub", np.array(latent.radius), rho)
    inward = graph("Mul", away, np.array(latent.decay[0]))
    around = graph("Mul", rho, np.array(latent.turn))
    rows = [
        graph("Sub", graph("Mul", inward, x), graph("Mul", around, y)),
        graph("Add", graph("Mul", inward, y), graph("Mul", around, x)),
        *[graph("Mul", other, -latent.decay[1:].reshape(-1, 1)) for other in others],
    ]
    return graph("Concat", *rows, axis=0)


def _polar(graph: Graph, z: str, d: int) -> tuple[str, str, str, list[str]]:
    """Return the direction (x, y), that of the first axis at the origin, rho and the rest."""
    x, y, *others = graph.split(z, [1, 1, d - 2] if d > 2 else [1, 1])
    rho = graph("Sqrt", graph("Add", graph("Mul", x, x), graph("Mul", y, y)))
    off, one = graph("Greater", rho, np.array(0.0)), np.array(1.0)
    safe = graph("Where", off, rho, one)
    return graph("Where", off, graph("Div", x, safe), one), graph("Div", y, safe), rho, others


def _planar_exponential(graph: Graph, drift: FloatArray, z: str, time: str) -> str:
    """Return even z + odd (A - m I) z, m = tr A / 2: see `latent`. Which branch it is, A says."""
    mean = np.trace(drift) / 2
    centred = drift - mean * np.eye(2)
    square = centred[0, 0] ** 2 + centred[0, 1] * centred[1, 0]
    rate = np.sqrt(abs(square))
    decay = graph("Exp", graph("Mul", time, np.array(mean)))
    if square > 0:
        slow = graph("Exp", graph("Mul", time, np.array(mean + rate)))
        fast = graph("Exp", graph("Mul", time, np.array(mean - rate)))
        even = graph("Mul", graph("Add", slow, fast), np.array(0.5))
        odd = graph("Mul", graph("Sub", slow, fast), np.array(0.5 / rate))
        # The difference cancels where the eigenvalues hardly part: a series there.
        angle2 = graph("Mul", graph("Mul", time, time), np.array(square))
        ahead = graph("Add", graph("Mul", angle2, np.array(1 / 20)), np.array(1.0))
        series = graph(
            "Add", graph("Div", graph("Mul", angle2, ahead), np.array(6.0)), np.array(1.0)
        )
        near = graph("Less", angle2, np.array(1e-4))
        odd = graph("Where", near, graph("Mul", graph("Mul", decay, time), series), odd)
    elif square < 0:
        angle = graph("Mul", time, np.array(rate))
        even = graph("Mul", decay, graph("Cos", angle))
        odd = graph("Mul", decay, graph("Div", graph("Sin", angle), np.array(rate)))
    else:
        even, odd = decay, graph("Mul", decay, time)
    turned = graph("MatMul", centred, z)
    return graph("Add", graph("Mul", even, z), graph("Mul", odd, turned))


def _exponential(graph: Graph, drift: FloatArray, z: str, time: str) -> str:
    """exp(A t) z: T(A t / 2^s)^(2^s) z with the Taylor polynomial T, and s for each t."""
    size, d = max(float(np.abs(drift).sum(axis=1).max()), 1e-300), len(drift)
    # log2(2 |A| t), at least 0
    doubled = graph("Log", graph("Mul", time, np.array(2 * size)))
    squarings = graph("Ceil", graph("Div", doubled, np.array(np.log(2))))
    squarings = graph("Max", squarings, np.array(0.0))
    scaled = graph("Div", time, graph("Pow", np.array(2.0), squarings))
    scaled = graph("Reshape", scaled, np.array([-1, 1, 1]))
    matrix, eye = graph("Mul", scaled, drift), np.eye(d)
    power = graph("Add", graph("Div", matrix, np.array(float(TAYLOR_ORDER))), eye)
    for order in range(TAYLOR_ORDER - 1, 0, -1):
        product = graph("MatMul", matrix, power)
        power = graph("Add", graph("Div", product, np.array(float(order))), eye)
    columns = graph("Reshape", graph("Transpose", z, perm=[1, 0]), np.array([-1, d, 1]))
    power = graph.squared(power, graph("Reshape", squarings, np.array([-1, 1, 1])))
    moved = graph("Reshape", graph("MatMul", power, columns), np.array([-1, d]))
    return graph("Transpose", moved, perm=[1, 0])
