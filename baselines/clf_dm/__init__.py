"""CLF-DM: a regression made stable by a learned control Lyapunov function."""

from iflow_gym.baselines.clf_dm.config import CLFDMConfig
from iflow_gym.baselines.clf_dm.model import CLFDM

__all__ = ["CLFDM", "CLFDMConfig"]
