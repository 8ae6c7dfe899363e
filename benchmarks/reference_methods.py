"""The numbers that the references' pages quote: `python benchmarks/reference_methods.py`.

Four minutes. Time to fit all six on the 30 LASA shapes, accuracy, what SEDS' error is made of on
this data, the cost of a step. One thread; nothing here is asserted anywhere.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy and torch are loaded

import time

import gymnasium
import numpy as np
import torch

import iflow_gym
from iflow_gym import metrics
from iflow_gym.baselines.registry import load_method
from iflow_gym.datasets.lasa import MULTI_MODELS, SINGLE_MOTIONS, load_lasa
from iflow_gym.demonstrations import Demonstrations
from iflow_gym.evaluate import evaluate
from iflow_gym.policy import policy_of
from iflow_gym.registration import lasa_id

METHODS = ("gpr", "lwr", "bc", "dmp", "promp", "kmp")
SHAPES = (*SINGLE_MOTIONS, *MULTI_MODELS)
BATCH = 15
"""Motions that are fitted together by methods that can, as `baselines/run_all.py` does."""

ANCHOR = {"Angle": 1.8, "Sshape": 1.8, "Sharpc": 1.7}
"""Fréchet distances of a ProMP conditioned on the start, measured before this one was written."""


def fit_everything():
    print("Fitting all demonstrations of the 30 shapes, one thread")
    fitted, total = {}, 0.0
    shown = {shape: load_lasa(shape) for shape in SHAPES}
    for name in METHODS:
        began = time.perf_counter()
        systems = []
        for k in range(0, len(SHAPES), BATCH):
            batch = [shown[s] for s in SHAPES[k : k + BATCH]]
            systems += load_method(name)().fit_many(batch, seeds=[0] * len(batch))
        seconds = time.perf_counter() - began
        fitted[name] = dict(zip(SHAPES, systems, strict=True))
        total += seconds
        print(f"  {name:6s} {seconds:6.1f} s")
    print(f"  all    {total:6.1f} s")
    return fitted


def accuracy(fitted):
    print("\nFréchet distance in mm, reproduction, in the environment; and means over LASA-26")
    for name in METHODS:
        found = {}
        for shape in SINGLE_MOTIONS:
            env = gymnasium.make(lasa_id(shape))
            scores = evaluate(fitted[name][shape], env, seed=0, stability=False).metrics
            found[shape] = (scores["frechet"], scores["rmse"])
        three = ", ".join(f"{s} {found[s][0]:.2f} ({bar})" for s, bar in ANCHOR.items())
        frechet, rmse = np.mean(list(found.values()), axis=0)
        print(f"  {name:6s} {three}; mean {frechet:.2f}, RMSE {rmse:.2f}")


def thinned(shown, n, every=5):
    """Return the first n demonstrations with every fifth sample, the last among them."""
    some = shown.subset(range(n))
    return Demonstrations.from_arrays(
        [p[::-1][::every][::-1] for p in some.positions],
        velocities=[v[::-1][::every][::-1] for v in some.velocities],
        dt=[h * every for h in some.dt],
        goal=some.goal,
    )


def seds_errors(system, shown, keep):
    """Return SEDS' error over the samples that `keep` leaves of each demonstration."""
    return np.mean(
        [
            metrics.seds_error(v[keep(v)], system.velocity(p[keep(v)]))
            for p, v in zip(shown.positions, shown.velocities, strict=True)
        ]
    )


def faster_than_slowest(share):
    def keep(v):
        speed = np.linalg.norm(v, axis=1)
        return speed > np.quantile(speed, share)

    return keep


def seds(fitted):
    print("\nSEDS' error on the fitted data, mean over LASA-26 (SEDS 2011: GPR 0.04, GMR 0.13)")
    gmr = {s: load_method("gmr")().fit(load_lasa(s), seed=0) for s in SINGLE_MOTIONS}
    systems = {"gpr": fitted["gpr"], "gmr": gmr}
    rows = {
        "all samples": lambda v: slice(None),
        "all but the last, whose velocity is set to 0": lambda v: slice(-1),
        "without the slowest 5 %": faster_than_slowest(0.05),
        "without the slowest 25 %": faster_than_slowest(0.25),
    }
    for label, keep in rows.items():
        values = [
            np.mean([seds_errors(systems[m][s], load_lasa(s), keep) for s in SINGLE_MOTIONS])
            for m in systems
        ]
        print(f"  {label:46s} gpr {values[0]:.3f}  gmr {values[1]:.3f}")
    for n in (3, 1):
        few = {s: thinned(load_lasa(s), n) for s in SINGLE_MOTIONS}
        whole = {"n_inducing": 600, "likelihood_samples": 600}  # every sample: the exact posterior
        own = {
            "gpr": {s: load_method("gpr")(**whole).fit(d, seed=0) for s, d in few.items()},
            "gmr": {s: load_method("gmr")().fit(d, seed=0) for s, d in few.items()},
        }
        for label in ("all samples", "without the slowest 5 %"):
            values = [
                np.mean([seds_errors(own[m][s], few[s], rows[label]) for s in SINGLE_MOTIONS])
                for m in own
            ]
            shown = f"{n} x 200 samples: {label}"
            print(f"  {shown:46s} gpr {values[0]:.3f}  gmr {values[1]:.3f}")


def cost(fitted):
    print("\nOne step of 256 states on Sshape, and the scoring of it")
    motion = load_lasa("Sshape")
    x = np.random.default_rng(0).uniform(*motion.bounding_box, size=(256, 2))
    for name in METHODS:
        system = fitted[name]["Sshape"]
        envs = gymnasium.make_vec(
            lasa_id("Sshape"), num_envs=256, vectorization_mode="vector_entry_point"
        )
        envs.reset(seed=0)
        policy, state = policy_of(system, envs), None
        times = []
        for _ in range(100):
            began = time.perf_counter()
            _, state = policy.predict(x, state)
            times.append(time.perf_counter() - began)
        began = time.perf_counter()
        found = evaluate(system, gymnasium.make(lasa_id("Sshape")), seed=0).metrics
        seconds = time.perf_counter() - began
        print(
            f"  {name:6s} {1e3 * np.median(times):.2f} ms; scoring {seconds:.1f} s; converged "
            f"{found['converged']:.2f}, diverged {found['diverged']:.2f}, spurious "
            f"{found['spurious_attractors']:.0f}, recovery {found['perturbation_recovery']:.2f}, "
            f"step {found['step_us']:.0f} us"
        )


if __name__ == "__main__":
    torch.set_num_threads(1)
    print(f"iflow_gym {iflow_gym.__version__}")
    fitted = fit_everything()
    accuracy(fitted)
    seds(fitted)
    cost(fitted)
