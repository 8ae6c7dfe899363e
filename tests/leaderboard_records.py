"""Records that are made up, so that what the leaderboard should say of them is known."""

from iflow_gym.datasets.lasa import MULTI_MODELS, SINGLE_MOTIONS
from iflow_gym.metrics import metrics_hash, metrics_of
from iflow_gym.registration import lasa_id
from iflow_gym.results import Result
from iflow_gym.system import Guarantee


def record(method, shape, scale=1.0, **changes):
    """Return a record whose every score is `scale` times a number that depends on the shape."""
    shapes = [*SINGLE_MOTIONS, *MULTI_MODELS]
    value = scale * (1 + shapes.index(shape) / 10)
    metrics = {m.name: value for m in metrics_of("goal")} | {"converged": min(1.0, 1 / scale)}
    metrics |= {"diverged": 0.0, "perturbation_recovery": 0.5, "lyapunov_violation": None}
    fields = {
        "method": method,
        "title": method.capitalize(),
        "environment": lasa_id(shape),
        "family": "LASA-26" if shape in SINGLE_MOTIONS else "LASA-Multi",
        "protocol": "reproduction",
        "seed": 0,
        "preset": "standard",
        "status": "ok",
        "key": "k",
        "created": "2026-01-02T03:04:05+00:00",
        "metrics": metrics,
        "guarantee": Guarantee("proved", "made up for a test"),
        "integrator": "exact",
        "dt": 0.005,
        "fit": {"batch_size": 1},
        "hashes": {"metrics": metrics_hash("goal"), "core": "c", "data": shape},
        "versions": {"python": "3.12", "numpy": "2.0"},
        "hardware": {"cpu": "abacus", "cores": 2, "threads": 1, "platform": "wood"},
    }
    return Result(**{**fields, **changes})


def failed(method, shape, reason="RuntimeError: it | broke\nfile.py:1", **changes):
    return record(
        method, shape, status="failed", reason=reason, metrics={}, guarantee=None, **changes
    )


def sweep(method, scale=1.0, shapes=SINGLE_MOTIONS, **changes):
    return [record(method, shape, scale, **changes) for shape in shapes]
