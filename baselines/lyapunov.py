"""Lyapunov functions of the baselines in closed form, with their gradients."""

from __future__ import annotations

from typing import Any

from iflow_gym.baselines.imitation_flow import ImitationFlow
from iflow_gym.baselines.imitation_flow.lyapunov import FlowLyapunov
from iflow_gym.residual.shield import LyapunovFunction


def lyapunov_function(system: Any) -> LyapunovFunction | None:
    """Return the Lyapunov function of a fitted system; None where it has none in closed form."""
    return FlowLyapunov(system) if isinstance(system, ImitationFlow) else None
