"""What `run_all.py` is made of, in the order of a run.

`presets` reads what to run, `fingerprint` hashes what decides the scores, `plan` makes cells and
jobs of both, `scoring` fits and scores a cell, `work` does so in a worker process, `pool` keeps the
workers going, and `report` tells a person.
"""
