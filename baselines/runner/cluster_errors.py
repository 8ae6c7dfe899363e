"""Errors of a Dask cluster, apart from what needs Dask to be imported."""


class ClusterError(RuntimeError):
    """A run on a Dask cluster cannot begin, or cannot go on."""
