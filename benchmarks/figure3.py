"""Figure 3 of the ImitationFlow paper, from records: `python benchmarks/figure3.py`.

ImitationFlow, CLF-DM and SEDS on the four metrics of the paper, over LASA-26, reproduction: box
plots of the shapes' means over the seeds, medians over the shapes with 95 % bootstrap intervals for
which shapes are drawn anew, and seeds within each, and for each pair of neighbours in the paper's
order on how many shapes the first is ahead. The records are those of
`baselines/run_all.py --preset full`.

    python benchmarks/figure3.py --results leaderboard/results --output docs/images/figure3.png
"""

import argparse
import itertools
from pathlib import Path

import numpy as np

from iflow_gym.figures import box_figure, method_styles, save_figure
from iflow_gym.results import read_results

ROOT = Path(__file__).parents[1]
ORDER = ("imitation-flow", "clf-dm", "seds")
PANELS = {
    "seds_error": "SEDS error",
    "frechet": "Fréchet distance (mm)",
    "swept_area": "Swept area (mm²)",
    "dtw": "DTW distance / sample (mm)",
}
N_RESAMPLES = 10_000


def scores(records, method, metric):
    """Return environment to its seeds' scores, nan for a cell that failed."""
    found = {}
    for record in records:
        if (record.method, record.protocol, record.family) == (method, "reproduction", "LASA-26"):
            value = record.metrics.get(metric) if record.ok else None
            found.setdefault(record.environment, []).append(np.nan if value is None else value)
    return {name: np.array(found[name], dtype=np.float64) for name in sorted(found)}


def median_interval(groups, rng):
    """Return the interval of the median over shapes of the means over seeds."""
    means = [
        group[rng.integers(len(group), size=(N_RESAMPLES, len(group)))].mean(axis=1)
        for group in groups.values()
    ]
    drawn = rng.integers(len(means), size=(len(means), N_RESAMPLES))
    resampled = np.take_along_axis(np.stack(means), drawn, axis=0)
    return np.nanquantile(np.nanmedian(resampled, axis=0), [0.025, 0.975])


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--results", type=Path, default=ROOT / "leaderboard" / "results")
    parser.add_argument("--output", type=Path, default=ROOT / "docs" / "images" / "figure3.png")
    options = parser.parse_args()
    records = [r for r in read_results(options.results) if r.method in ORDER]
    methods = [m for m in ORDER if any(r.method == m for r in records)]
    if missing := sorted(set(ORDER) - set(methods)):
        print(f"No records of {', '.join(missing)} in {options.results}: drawn without.")
    about = {r.method: (r.title, r.guarantee.kind) for r in records if r.guarantee is not None}
    table = method_styles({m: about[m] for m in methods}, ORDER)
    panels = {}
    print(f"{'metric':12s} {'method':16s} {'median':>10s}  95 % interval        shapes x seeds")
    for metric, label in PANELS.items():
        panels[label], means = {}, {}
        for method in methods:
            groups = scores(records, method, metric)
            means[method] = {name: group.mean() for name, group in groups.items()}
            panels[label][method] = list(means[method].values())
            low, high = median_interval(groups, np.random.default_rng(0))
            seeds = sorted({len(group) for group in groups.values()})
            print(
                f"{metric:12s} {method:16s} {np.nanmedian(panels[label][method]):10.3f}  "
                f"[{low:.3f}, {high:.3f}]".ljust(62)
                + f"{len(groups)} x {'-'.join(map(str, seeds))}"
            )
        for first, second in itertools.pairwise(methods):
            shared = sorted(set(means[first]) & set(means[second]))
            ahead = sum(means[first][s] < means[second][s] for s in shared)
            print(f"{'':12s} {first} ahead of {second} on {ahead} of {len(shared)} shapes")
    save_figure(box_figure(panels, table), options.output)
    print(f"wrote {options.output}")


if __name__ == "__main__":
    main()
