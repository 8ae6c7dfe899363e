"""A step of one state, and of 1000, by every way to run a flow: microseconds on one thread.

    python benchmarks/real_time.py [--emission spline] [--n-layers 24] [--n-dims 2] [--compile]

The flows have random weights of a trained flow's size and a linear latent system; all ways compute
the same step in float64, and the largest difference to the batched NumPy path is printed beside
the median. ONNX needs the extra ``onnx``; ``--compile`` also tries `torch.compile`, which needs a
C++ compiler. TorchScript and the compiler are for coupling layers, written out in torch operations;
the other emissions have the flow that is trained for an eager torch. torch's difference is that of
its `matrix_exp`, which is only good to 1e-10 for a single float64 matrix of norm 0.01 to 0.05; for
a batch of them it is exact to rounding.
"""

import io
import statistics
import tempfile
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch
import tyro
from torch import Tensor, nn

from iflow_gym.baselines.imitation_flow.config import Emission, ImitationFlowConfig
from iflow_gym.baselines.imitation_flow.emissions import make_field, make_flow
from iflow_gym.baselines.imitation_flow.export import export
from iflow_gym.baselines.imitation_flow.fields import coupling
from iflow_gym.baselines.imitation_flow.fields.latents import LinearField
from iflow_gym.baselines.imitation_flow.flow import Flow
from iflow_gym.baselines.imitation_flow.realtime import MeanDynamics, RealTimeStepper


@dataclass(frozen=True)
class Options:
    """What to measure."""

    emission: Emission = "coupling"
    """Layers of the flow."""
    n_layers: int = 24
    """How many."""
    n_hidden: int = 16
    """Units in each."""
    n_dims: int = 2
    """Dimension of the state."""
    log_scale_bound: float = 0.3
    """Bound of the log-scales."""
    repeats: int = 200
    """Timings, interleaved over the ways; the median is reported."""
    compile: bool = False
    """Whether to try `torch.compile`."""


class TorchStep(nn.Module):
    """The step in plain torch operations, which TorchScript and the compiler can read."""

    def __init__(self, dynamics: MeanDynamics) -> None:
        super().__init__()
        flow = dynamics.flow
        layers = zip(*flow.arrays.values(), strict=True)
        self.layers = [[torch.as_tensor(a) for a in layer] for layer in layers]
        self.bound, self.kept, self.moved = flow.bound, flow.n_kept, flow.n_dims - flow.n_kept
        self.drift = torch.as_tensor(dynamics.latent.drift)
        self.attractor = torch.as_tensor(dynamics.attractor)[:, None]

    def coefficients(self, layer: list[Tensor], a: Tensor) -> tuple[Tensor, Tensor]:
        """Log-scale and shift."""
        _, weight, bias, out_weight, out_bias = layer
        units = torch.tanh(torch.addmm(bias[:, None], weight, a))
        out = torch.addmm(out_bias[:, None], out_weight, units)
        return self.bound * torch.tanh(out[: self.moved] / self.bound), out[self.moved :]

    def forward(self, x: Tensor, dt: Tensor) -> Tensor:
        """Return the states (n, d) a time dt after x (n, d)."""
        y = x.T
        for layer in reversed(self.layers):
            a, b = y[: self.kept], y[self.kept :]
            log_scale, shift = self.coefficients(layer, a)
            y = layer[0].T @ torch.cat([a, (b - shift) * torch.exp(-log_scale)])
        z = torch.linalg.matrix_exp(self.drift * dt) @ (y - self.attractor) + self.attractor
        for layer in self.layers:
            z = layer[0] @ z
            a, b = z[: self.kept], z[self.kept :]
            log_scale, shift = self.coefficients(layer, a)
            z = torch.cat([a, b * torch.exp(log_scale) + shift])
        return z.T


class TorchFlowStep(nn.Module):
    """The step by the flow that is trained, in any emission."""

    def __init__(self, dynamics: MeanDynamics, flow: Flow) -> None:
        super().__init__()
        self.flow = flow
        self.drift = torch.as_tensor(dynamics.latent.drift)
        self.attractor = torch.as_tensor(dynamics.attractor)[:, None]

    def forward(self, x: Tensor, dt: Tensor) -> Tensor:
        """Return the states (n, d) a time dt after x (n, d)."""
        y, _ = self.flow.inverse(x.T[None])
        z = torch.linalg.matrix_exp(self.drift * dt) @ (y[0] - self.attractor) + self.attractor
        return self.flow(z[None])[0].T


def random_dynamics(options: Options) -> tuple[MeanDynamics, Flow]:
    """Return mean dynamics with the weights of a trained flow's size, and their flow in torch."""
    generator = torch.Generator().manual_seed(0)
    d = options.n_dims
    config = ImitationFlowConfig(
        emission=options.emission, n_layers=options.n_layers, n_hidden=options.n_hidden,
        log_scale_bound=options.log_scale_bound, sharpness=2.0,
    )  # fmt: skip
    flow = make_flow(config, d, 0, [generator]).double()
    with torch.no_grad():
        draw = torch.randn(flow.out_weight.shape, generator=generator, dtype=torch.float64)
        flow.out_weight += 0.1 * draw
        field = make_field(config, flow.arrays(0))
    drift = (
        np.diag(-np.linspace(1, 3, d)) + np.triu(np.ones((d, d)), 1) - np.tril(np.ones((d, d)), -1)
    )
    attractor = field.inverse(np.zeros((1, d)))[0][0]
    latent = LinearField(drift, np.eye(d))
    return MeanDynamics(field, latent, attractor, np.zeros(d), np.eye(d), 1.0), flow


def torch_ways(dynamics: MeanDynamics, flow: Flow, options: Options) -> dict[str, Callable]:
    """Return eager, TorchScript and compiled torch, from arrays to arrays."""
    if options.emission != "coupling":
        return {"torch, eager": torch_way(TorchFlowStep(dynamics, flow).eval())}
    eager = TorchStep(dynamics).eval()
    example = (torch.zeros(3, options.n_dims, dtype=torch.float64), torch.tensor(0.01).double())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        script = torch.jit.freeze(torch.jit.trace(eager, example))
        buffer = io.BytesIO()
        torch.jit.save(script, buffer)
    print(f"TorchScript file: {len(buffer.getvalue()) / 1024:.0f} KiB")
    modules = {"torch, eager": eager, "TorchScript, traced and frozen": script}
    if options.compile:
        modules["torch.compile"] = torch.compile(eager, dynamic=False)
    return {name: torch_way(module) for name, module in modules.items()}


def torch_way(module: Callable) -> Callable:
    """Return a module's step from arrays to arrays."""

    def step(x: np.ndarray, dt: float) -> np.ndarray:
        with torch.inference_mode():
            return module(torch.from_numpy(x), torch.tensor(dt, dtype=torch.float64)).numpy()

    return step


def onnx_ways(dynamics: MeanDynamics) -> dict[str, Callable]:
    """Return the exported file in ONNX Runtime, with and without the velocity."""
    import onnxruntime

    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads = settings.inter_op_num_threads = 1
    ways = {}
    for name, velocity in (("ONNX Runtime", False), ("ONNX Runtime, with velocity", True)):
        with tempfile.TemporaryDirectory() as folder:
            path = export(dynamics, Path(folder) / "step.onnx", velocity=velocity)
            content = path.read_bytes()
        print(f"{name}: file of {len(content) / 1024:.0f} KiB")
        session = onnxruntime.InferenceSession(content, settings)
        ways[name] = lambda x, dt, run=session.run: run(["x_next"], {"x": x, "dt": np.array([dt])})[
            0
        ]
    return ways


def main() -> None:
    """Print a table."""
    options = tyro.cli(Options, description=__doc__)
    torch.set_num_threads(1)
    dynamics, flow = random_dynamics(options)
    stepper = RealTimeStepper(dynamics)

    def batched(x: np.ndarray, dt: float) -> np.ndarray:
        z = dynamics.flow.inverse(x)[0] - dynamics.attractor
        moved = dynamics.latent.propagate(z, np.full(len(x), dt))
        return dynamics.flow.forward(moved + dynamics.attractor)

    ways = {
        "NumPy, single state": lambda x, dt: stepper.step(x[0], dt)[None],
        "NumPy, batch": batched,
        **onnx_ways(dynamics),
        **torch_ways(dynamics, flow, options),
    }
    for n in (1, 1000):
        x = np.random.default_rng(0).normal(size=(n, options.n_dims))
        shown = {k: way for k, way in ways.items() if n == 1 or "single" not in k}
        if options.emission == "coupling" and n >= coupling.TABULATED:
            shown["NumPy, batch without tables"] = batched
        expected = batched(x, 0.01)
        errors = {k: np.abs(way(x, 0.01) - expected).max() for k, way in shown.items()}
        times = {name: [] for name in shown}
        for _ in range(options.repeats):
            for name, way in shown.items():
                fewest = np.inf if "without" in name else coupling.TABULATED
                with patch.object(coupling, "TABULATED", fewest):
                    way(x, 0.01)  # what another way has pushed out of the caches comes back
                    began = time.perf_counter()
                    way(x, 0.01)
                    times[name].append(time.perf_counter() - began)
        medians = {name: statistics.median(values) for name, values in times.items()}
        best = min(medians.values())
        print(
            f"\n{n} state(s), {options.n_layers} {options.emission} layers of {options.n_hidden}, "
            f"d = {options.n_dims}"
        )
        print(f"{'':32} {'median us':>9} {'least us':>9} {'ratio':>6} {'difference':>10}")
        for name, median in sorted(medians.items(), key=lambda item: item[1]):
            row = (name, median * 1e6, min(times[name]) * 1e6, median / best, errors[name])
            print("{:32} {:9.0f} {:9.0f} {:6.1f} {:10.1e}".format(*row))


if __name__ == "__main__":
    main()
