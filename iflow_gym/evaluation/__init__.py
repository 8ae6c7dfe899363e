"""The parts of `iflow_gym.evaluate`: rollouts, and the scores of each kind of motion."""
