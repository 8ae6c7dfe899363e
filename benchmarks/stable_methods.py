"""SEDS and CLF-DM beside the published numbers, in one run: `python benchmarks/stable_methods.py`.

1. Reproduction, scored by the environment, on LASA-26 or `--shapes`: seconds of one core to fit,
   microseconds a step, SEDS error, Fréchet distance, swept area, and whether every start of the
   grid converged.
2. SEDS by the protocol of LPV-DS: fitted on every 2nd sample of recordings 1-4, scored on 5-7, with
   both objectives: the public script of LPV-DS's evaluation sets the mean square error. The
   published "velocity RMSE" is the mean over the samples of |v - v^| / sqrt(2), as the code of
   LPV-DS computes it (`rmse_error.m`, which takes the mean over the two coordinates first): both
   are printed.
3. SEDS's solvers beside each other, on three shapes: the same start and objective.

On one thread, whose seconds are counted and not the clock's: other work on the machine then matters
less. Nothing here is a test.
"""

import argparse
import itertools
import time

import gymnasium as gym
import numpy as np
from threadpoolctl import threadpool_limits

from iflow_gym.baselines.clf_dm import CLFDM
from iflow_gym.baselines.seds import SEDS
from iflow_gym.datasets.lasa import MULTI_MODELS, SINGLE_MOTIONS, load_lasa
from iflow_gym.demonstrations import Demonstrations
from iflow_gym.evaluate import evaluate
from iflow_gym.metrics import direction_error, velocity_rmse
from iflow_gym.registration import lasa_id

COLUMNS = ("step_us", "seds_error", "frechet", "swept_area", "converged", "lyapunov_violation")


def reproduction(shapes):
    for method in (SEDS, CLFDM):
        print(f"\n{method.title}: reproduction")
        print(f"{'shape':16s} {'fit s':>8s} " + " ".join(f"{c:>18s}" for c in COLUMNS))
        rows = {}
        for shape in shapes:
            began = time.process_time()
            system = method().fit(load_lasa(shape), seed=0)
            seconds = time.process_time() - began
            found = evaluate(system, gym.make(lasa_id(shape)), seed=0).metrics
            rows[shape] = [seconds, *(found[c] for c in COLUMNS)]
            print(f"{shape:16s} {seconds:8.2f} " + " ".join(f"{v:18.3f}" for v in rows[shape][1:]))
        single = np.array([rows[s] for s in rows if s in SINGLE_MOTIONS])
        middle = np.median(single, axis=0)
        print(f"{'median':16s} {middle[0]:8.2f} " + " ".join(f"{v:18.3f}" for v in middle[1:]))


def generalisation(shapes):
    print("\nSEDS: generalisation, every 2nd sample (published: 0.099, 6.34)")
    for objective in ("likelihood", "mse"):
        rows = []
        for shape in shapes:
            full = load_lasa(shape)
            thin = Demonstrations.from_arrays(
                [p[::2] for p in full.positions],
                velocities=[v[::2] for v in full.velocities],
                dt=[2 * h for h in full.dt],
                goal=full.goal,
            )
            split = thin.split("generalisation")
            system = SEDS(objective=objective).fit(split.fit, seed=0)
            for v, p in zip(split.score.velocities, split.score.positions, strict=True):
                made = system.velocity(p)
                apart = np.linalg.norm(v - made, axis=1).mean() / np.sqrt(2)
                rows.append([direction_error(v, made), velocity_rmse(v, made), apart])
        direction, ours, theirs = np.mean(rows, axis=0)
        print(
            f"{objective:12s} direction error {direction:.3f}, velocity RMSE {ours:.2f} mm/s, as "
            f"LPV-DS computes it {theirs:.2f} mm/s, over {len(shapes)} shapes"
        )


def solvers(shapes):
    print("\nSEDS's solvers, one start of EM, 500 iterations: -log-likelihood a sample, seconds")
    for n, shape in itertools.product((5, 10), shapes):
        for solver in ("L-BFGS-B", "SLSQP", "trust-constr"):
            motion = load_lasa(shape)
            began = time.process_time()
            system = SEDS(solver=solver, n_components=n, n_initialisations=1).fit(motion, seed=0)
            seconds = time.process_time() - began
            x, v = np.concatenate(motion.positions), np.concatenate(motion.velocities)
            field = system.field_
            logs = field.log_prob(x, v) + np.logaddexp.reduce(field.log_densities(x), axis=1)
            print(f"{n:4d} {shape:10s} {solver:14s} {-logs.mean():9.4f} {seconds:7.2f} s")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--shapes", nargs="*", default=[*SINGLE_MOTIONS, *MULTI_MODELS])
    parser.add_argument("--parts", nargs="*", default=["reproduction", "generalisation", "solvers"])
    options = parser.parse_args()
    with threadpool_limits(1):
        if "reproduction" in options.parts:
            reproduction(options.shapes)
        if "generalisation" in options.parts:
            generalisation([s for s in options.shapes if s in SINGLE_MOTIONS])
        if "solvers" in options.parts:
            solvers(["Angle", "Sshape", "Sharpc"])
