"""Minari datasets: the suite's demonstrations as ones, and others' as demonstrations.

Needs the extra ``minari``; datasets are written to the user's disk and are no part of the package.
"""

from iflow_gym.minari_datasets.export import dataset_id_of, export_minari, exportable
from iflow_gym.minari_datasets.reading import read_minari

__all__ = [
    "dataset_id_of",
    "export_minari",
    "exportable",
    "read_minari",
]
