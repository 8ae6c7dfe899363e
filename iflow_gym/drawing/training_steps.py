"""How long ImitationFlow is trained for the page."""

from __future__ import annotations

from dataclasses import dataclass, fields


@dataclass(frozen=True)
class TrainingSteps:
    """Steps of the trainings that follow one another."""

    preview: int = 150
    """Of the first, which shows something within two seconds."""
    quick: int = 600
    """Of the one that replaces it."""
    full: int | None = None
    """Of the one that "refine" asks for; None takes the method's default."""

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if (value is not None or entry.name != "full") and (
                type(value) is not int or value < 1
            ):
                raise ValueError(
                    f"Expected a whole number of {entry.name} steps >= 1, got {value!r}."
                )
