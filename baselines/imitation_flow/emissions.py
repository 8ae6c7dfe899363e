"""The emissions by name: what trains (torch) and what runs (NumPy)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from numpy.typing import NDArray

from iflow_gym.baselines.imitation_flow.autoregressive import AutoregressiveFlow
from iflow_gym.baselines.imitation_flow.config import ImitationFlowConfig
from iflow_gym.baselines.imitation_flow.coupling import CouplingFlow
from iflow_gym.baselines.imitation_flow.fields.autoregressive import AutoregressiveField
from iflow_gym.baselines.imitation_flow.fields.base import FlowField
from iflow_gym.baselines.imitation_flow.fields.coupling import CouplingField
from iflow_gym.baselines.imitation_flow.fields.spline import SplineField
from iflow_gym.baselines.imitation_flow.flow import Flow
from iflow_gym.baselines.imitation_flow.spline import SplineFlow

FIELDS: dict[str, type[FlowField]] = {
    "coupling": CouplingField,
    "autoregressive": AutoregressiveField,
    "spline": SplineField,
}


def make_flow(
    config: ImitationFlowConfig,
    n_dims: int,
    n_context: int,
    generators: list[torch.Generator],
    *,
    cyclic: bool = False,
) -> Flow:
    """Return an untrained flow for motions that end or repeat, one model for each generator."""
    sizes = (n_dims, config.n_layers, config.n_hidden, n_context)
    shape: dict[str, Any] = {
        "log_scale_bound": config.log_scale_bound,
        "sharpness": config.resolved(cyclic=cyclic, n_dims=n_dims).sharpness,
        "generators": generators,
    }
    if config.emission == "spline":
        return SplineFlow(*sizes, n_bins=config.n_bins, bound=config.spline_bound, **shape)
    return {"coupling": CouplingFlow, "autoregressive": AutoregressiveFlow}[config.emission](
        *sizes, **shape
    )


def make_field(config: ImitationFlowConfig, arrays: Mapping[str, NDArray[Any]]) -> FlowField:
    """Return the flow of a trained model; raise KeyError or ValueError for what is none."""
    return FIELDS[config.emission](arrays, config)
