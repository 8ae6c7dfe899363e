"""Drumming with a robot arm: `iflow/Drumming-v0` and `iflow/DrummingRecorded-v0`."""
