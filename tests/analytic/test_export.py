"""The exported file in the runtime alone, in a folder and a process that lack this package."""

import builtins
import json
import subprocess
import sys

import numpy as np
import pytest
from imitation_flow_parts import (
    EMISSIONS,
    cycle_latent,
    dynamics,
    linear_latent,
    states,
    step,
    velocity,
)

from iflow_gym.baselines.imitation_flow.export import FORMAT_VERSION, export

pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")

ALONE = """
import sys
import numpy as np, onnxruntime

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("iflow_gym", "torch", "scipy"):
            raise ImportError(name)

sys.meta_path.insert(0, Absent())
try:
    import iflow_gym
except ImportError:
    pass
else:
    raise SystemExit("expected no iflow_gym here")
asked = np.load("asked.npz")
session = onnxruntime.InferenceSession("model.onnx")
got = {}
for i, dt in enumerate(asked["dt"]):
    given = {"x": asked["x"], "dt": [dt]}
    got[f"x{i}"], got["velocity"] = session.run(["x_next", "velocity"], given)
got["each"] = session.run(["x_next"], {"x": asked["x"], "dt": asked["each"]})[0]
np.savez("got.npz", **got)
"""

DEFECTIVE = [[-3.0, 1.0], [0.0, -3.0]]
JORDAN = [[-1.0, 0.5, 0.0], [0.0, -1.0, 0.5], [0.0, 0.0, -1.0]]
LATENTS = {
    "plane, complex": (2, lambda: linear_latent(2, drift=[[-3.0, 1.0], [-1.0, -3.0]])),
    "plane, real": (2, lambda: linear_latent(2, drift=[[-4.0, 0.5], [0.5, -0.5]])),
    "plane, nearly equal": (2, lambda: linear_latent(2, drift=[[-3.0, 1e-4], [1e-4, -3.0]])),
    "plane, equal": (2, lambda: linear_latent(2, drift=[[-3.0, 0.0], [0.0, -3.0]])),
    "plane, defective": (2, lambda: linear_latent(2, drift=DEFECTIVE)),
    "space": (3, lambda: linear_latent(3)),
    "space, defective": (3, lambda: linear_latent(3, drift=JORDAN)),
    "six dimensions": (6, lambda: linear_latent(6)),
    "cycle in the plane": (2, lambda: cycle_latent(2)),
    "cycle in space": (3, lambda: cycle_latent(3)),
    "cycle in six dimensions": (6, lambda: cycle_latent(6)),
}
TIMES = np.array([1e-6, 0.01, 0.3, 5.0, 400.0])


def loaded(path):
    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads = settings.inter_op_num_threads = 1
    return onnxruntime.InferenceSession(str(path), settings)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("emission", EMISSIONS)
def test_the_runtime_alone_steps_as_the_system(d, emission, tmp_path):
    parts = dynamics(d, emission=emission)
    x = states(parts)
    each = np.random.default_rng(0).uniform(0.001, 3, len(x))
    export(parts, tmp_path / "model.onnx")
    np.savez(tmp_path / "asked.npz", x=x, dt=TIMES, each=each)
    subprocess.run(
        [sys.executable, "-W", "ignore", "-I", "-c", ALONE], cwd=tmp_path, check=True, timeout=60
    )
    got = np.load(tmp_path / "got.npz")
    for i, dt in enumerate(TIMES):
        expected = step(parts, x, np.full(len(x), dt))
        np.testing.assert_allclose(got[f"x{i}"], expected, rtol=0, atol=1e-10)
    np.testing.assert_allclose(got["each"], step(parts, x, each), rtol=0, atol=1e-10)
    np.testing.assert_allclose(got["velocity"], velocity(parts, x), rtol=0, atol=1e-10)


@pytest.mark.parametrize("name", LATENTS)
def test_every_latent_system(name, tmp_path):
    d, latent = LATENTS[name]
    parts = dynamics(d, latent())
    x = states(parts)
    session = loaded(export(parts, tmp_path / "model.onnx"))
    for dt in TIMES:
        got, rate = session.run(["x_next", "velocity"], {"x": x, "dt": np.array([dt])})
        expected = step(parts, x, np.full(len(x), dt))
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-10)
    np.testing.assert_allclose(rate, velocity(parts, x), rtol=0, atol=1e-10)
    each = np.random.default_rng(0).uniform(0.001, 30, len(x))
    (got,) = session.run(["x_next"], {"x": x, "dt": each})
    np.testing.assert_allclose(got, step(parts, x, each), rtol=0, atol=1e-10)


def test_the_centre_of_a_cycle(tmp_path):
    parts = dynamics(2, cycle_latent(2))
    parts.origin[:] = -(parts.flow.forward(np.zeros((1, 2))) @ parts.frame.T)[0]
    session = loaded(export(parts, tmp_path / "model.onnx"))
    result = session.run(None, {"x": np.zeros((1, 2)), "dt": np.array([0.1])})
    assert np.isfinite(result).all()


@pytest.mark.parametrize("emission", EMISSIONS)
def test_far_away(emission, tmp_path):
    parts = dynamics(2, n_layers=24, emission=emission)
    x = states(parts, spread=3e4)
    session = loaded(export(parts, tmp_path / "model.onnx"))
    got, rate = session.run(None, {"x": x, "dt": np.array([0.1])})
    np.testing.assert_allclose(got, step(parts, x, np.full(len(x), 0.1)), rtol=1e-9)
    assert np.isfinite(rate).all()


def test_the_file_says_what_it_is(tmp_path):
    path = export(dynamics(3), tmp_path / "model.onnx", units="mm", dt=[0.01], guarantee="proved")
    said = loaded(path).get_modelmeta().custom_metadata_map
    assert {key: json.loads(value) for key, value in said.items()} == {
        "format_version": FORMAT_VERSION,
        "n_dims": 3,
        "units": "mm",
        "dt": [0.01],
        "guarantee": "proved",
    }
    assert [p.name for p in tmp_path.iterdir()] == ["model.onnx"]


@pytest.mark.parametrize("d", [2, 3, 6])
@pytest.mark.parametrize("emission", EMISSIONS)
def test_every_emission_over_a_cycle(d, emission, tmp_path):
    parts = dynamics(d, cycle_latent(d), emission=emission)
    x = states(parts, n=200)  # on both sides of where splines end
    session = loaded(export(parts, tmp_path / "model.onnx"))
    got, rate = session.run(None, {"x": x, "dt": np.array([0.3])})
    # A batch of couplings is looked up: see `coupling_table`.
    tables = 10 if emission == "coupling" and d < 4 else 1
    expected = step(parts, x, np.full(len(x), 0.3))
    np.testing.assert_allclose(got, expected, rtol=0, atol=tables * 1e-10)
    expected = velocity(parts, x)
    size = np.abs(expected).max()
    np.testing.assert_allclose(rate, expected, rtol=0, atol=tables * 1e-12 * size)


def test_a_file_without_the_velocity(tmp_path):
    parts = dynamics(2)
    session = loaded(export(parts, tmp_path / "model.onnx", velocity=False))
    assert [output.name for output in session.get_outputs()] == ["x_next"]
    x = states(parts)
    (got,) = session.run(None, {"x": x, "dt": np.array([0.1])})
    np.testing.assert_allclose(got, step(parts, x, np.full(len(x), 0.1)), rtol=0, atol=1e-10)


def test_other_parts_are_refused(tmp_path):
    parts = dynamics(2)
    for name, match in (
        ("flow", "coupling, autoregressive or spline layers"),
        ("latent", "linear latent system"),
    ):
        other = type("Other", (), {"n_dims": 2})()
        fields = {**vars(parts), name: other}
        with pytest.raises(TypeError, match=f"Expected a .*{match}.*, got Other"):
            export(type(parts)(**fields), tmp_path / "model.onnx")
    assert not list(tmp_path.iterdir())


def test_without_the_extra(tmp_path, monkeypatch):
    whole = builtins.__import__

    def without(name, *rest, **more):
        if name.split(".")[0] == "onnx":
            raise ImportError(name)
        return whole(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ImportError, match=r"pip install 'iflow-gym\[onnx\]'"):
        export(dynamics(2), tmp_path / "model.onnx")
