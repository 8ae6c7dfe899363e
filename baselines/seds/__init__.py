"""SEDS: the stable estimator of dynamical systems (Khansari-Zadeh & Billard, IEEE T-RO 2011)."""

from iflow_gym.baselines.seds.config import SEDSConfig
from iflow_gym.baselines.seds.model import SEDS

__all__ = ["SEDS", "SEDSConfig"]
