"""An agent's corrections on top of a learned motion, with and without its stability guarantee.

`ResidualActionWrapper` adds them to what a base policy commands, for reinforcement learning;
`ResidualPolicy` runs what was learned wherever a policy runs; `LyapunovShield` keeps the base's
Lyapunov function falling, whatever the agent wants.
"""

from iflow_gym.residual.policy import ResidualPolicy
from iflow_gym.residual.shield import LyapunovFunction, LyapunovShield
from iflow_gym.residual.wrapper import ResidualActionWrapper, ResidualVectorWrapper

__all__ = [
    "LyapunovFunction",
    "LyapunovShield",
    "ResidualActionWrapper",
    "ResidualPolicy",
    "ResidualVectorWrapper",
]
