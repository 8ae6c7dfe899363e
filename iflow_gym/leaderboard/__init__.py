"""Submissions to the leaderboard: what they consist of, and whether they are what they say.

``python -m iflow_gym.leaderboard check PATH`` is the command; `check` has the same in Python.
"""
