"""Environments, one module or folder a family; import them as `iflow_gym.envs`."""
