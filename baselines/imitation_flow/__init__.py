"""ImitationFlow (Urain et al., IROS 2020), the suite's baseline."""

from iflow_gym.baselines.imitation_flow.conditional import ConditionalImitationFlow
from iflow_gym.baselines.imitation_flow.config import ImitationFlowConfig
from iflow_gym.baselines.imitation_flow.model import ImitationFlow

__all__ = ["ConditionalImitationFlow", "ImitationFlow", "ImitationFlowConfig"]
