"""The suite's numbers: pure functions over NumPy arrays, and the table of what they mean.

Accuracy compares a reproduction with its demonstration, stability judges rollouts from many starts,
cycles compare orbits and tempos, cost measures a machine at work, and aggregates make one row of
many cells. Nothing here knows of methods or environments.
"""

from iflow_gym.metrics.accuracy import (
    direction_error,
    dtw,
    frechet,
    nll,
    rmse,
    seds_error,
    swept_area,
    swept_surface,
    velocity_rmse,
)
from iflow_gym.metrics.aggregate import (
    Aggregate,
    Bootstrap,
    aggregate_scores,
    interquartile_mean,
    mean_ranks,
    stratified_bootstrap,
)
from iflow_gym.metrics.cost import FitCost, measure_cost, median_call_us
from iflow_gym.metrics.cycles import (
    attracted,
    orbit_distance,
    orbit_hausdorff,
    period,
    period_error,
    phase_rmse,
)
from iflow_gym.metrics.registry import (
    METRICS,
    Metric,
    Motion,
    get_metric,
    metrics_hash,
    metrics_of,
)
from iflow_gym.metrics.stability import (
    HORIZON,
    box_diagonal,
    converged,
    convergence_tolerance,
    diverged,
    enlarged_box,
    fraction,
    lyapunov_violation,
    settling_time,
    spurious_attractors,
    start_grid,
    uniform_states,
)

__all__ = [
    "HORIZON",
    "METRICS",
    "Aggregate",
    "Bootstrap",
    "FitCost",
    "Metric",
    "Motion",
    "aggregate_scores",
    "attracted",
    "box_diagonal",
    "converged",
    "convergence_tolerance",
    "direction_error",
    "diverged",
    "dtw",
    "enlarged_box",
    "fraction",
    "frechet",
    "get_metric",
    "interquartile_mean",
    "lyapunov_violation",
    "mean_ranks",
    "measure_cost",
    "median_call_us",
    "metrics_hash",
    "metrics_of",
    "nll",
    "orbit_distance",
    "orbit_hausdorff",
    "period",
    "period_error",
    "phase_rmse",
    "rmse",
    "seds_error",
    "settling_time",
    "spurious_attractors",
    "start_grid",
    "stratified_bootstrap",
    "swept_area",
    "swept_surface",
    "uniform_states",
    "velocity_rmse",
]
