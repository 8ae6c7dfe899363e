"""What a `fit_many` raises where it learned some of its motions and not the others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from iflow_gym.system import Method


class PartialFitError(RuntimeError):
    """Some motions of a `fit_many` could not be learned; nothing that was learned is lost.

    A method that trains motions together raises it when the last of them is done, with the fitted
    systems of the others in it. `fit` raises the failure itself.

    Parameters
    ----------
    names : sequence of str
        The motions, in the order of `fit_many`.
    systems : sequence of (Method or None)
        What was fitted, ready for use, in that order; None where it failed.
    failures : mapping of int to Exception
        Why, by the place in that order.

    Attributes
    ----------
    names, systems, failures
        As given, as lists and a dictionary.

    Examples
    --------
    >>> from iflow_gym.partial_fits import PartialFitError
    >>> try:  # doctest: +SKIP
    ...     systems = method.fit_many(motions, seeds=seeds)
    ... except PartialFitError as error:
    ...     systems = error.systems
    ...     for place, failure in error.failures.items():
    ...         print(error.names[place], failure)
    """

    def __init__(
        self,
        names: Sequence[str],
        systems: Sequence[Method | None],
        failures: Mapping[int, Exception],
    ) -> None:
        super().__init__(list(names), list(systems), dict(failures))

    @property
    def names(self) -> list[str]:
        """The motions by name."""
        names: list[str] = self.args[0]
        return names

    @property
    def systems(self) -> list[Any]:
        """The fitted system of each motion, None where it failed."""
        systems: list[Any] = self.args[1]
        return systems

    @property
    def failures(self) -> dict[int, Exception]:
        """Why, by the place of the motion."""
        failures: dict[int, Exception] = self.args[2]
        return failures

    def __str__(self) -> str:
        why = "; ".join(
            f"{self.names[i]!r} at place {i}: {type(e).__name__}: {e}"
            for i, e in sorted(self.failures.items())
        )
        return (
            f"{len(self.failures)} of {len(self.names)} motions could not be learned, and the "
            f"others are in `systems` of this error: {why}"
        )
