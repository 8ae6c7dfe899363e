"""Presets: what to run, from ``presets/run.toml``, and methods' settings, from their own files."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

PRESETS_FOLDER = Path(__file__).parents[1] / "presets"

PresetName = Literal["smoke", "standard", "full"]
PRESETS: tuple[PresetName, ...] = get_args(PresetName)


@dataclass(frozen=True)
class Preset:
    """What a preset runs."""

    name: str
    environments: tuple[str, ...]
    """Globs over environments' ids and short names."""
    protocols: tuple[str, ...]
    seeds: tuple[int, ...]
    """Methods whose fit does not depend on the seed run with the first one alone."""
    time_limit: float
    """Seconds that a cell may take."""


class PresetError(ValueError):
    """A preset's file is missing or says something that is not understood."""


def load_preset(name: str) -> Preset:
    """Return a preset's section of ``run.toml``."""
    section = _section(PRESETS_FOLDER / "run.toml", name)
    fields: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in section.items()}
    try:
        return Preset(name=name, **fields)
    except TypeError as error:
        raise PresetError(f"{PRESETS_FOLDER / 'run.toml'}, section [{name}]: {error}.") from error


def load_settings(method: str, preset: str, *, registered: bool) -> dict[str, Any]:
    """Return a method's settings under a preset.

    A method of the registry must have a file with a section for each preset; a class from outside
    runs with its defaults.
    """
    if not registered:
        return {}
    section = _section(PRESETS_FOLDER / f"{method}.toml", preset)
    return {k: tuple(v) if isinstance(v, list) else v for k, v in section.items()}


def _section(path: Path, name: str) -> dict[str, Any]:
    if not path.is_file():
        raise PresetError(
            f"Expected a preset at {path}, got none: write one with sections "
            f"{', '.join(f'[{p}]' for p in PRESETS)}; an empty section takes the defaults."
        )
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except tomllib.TOMLDecodeError as error:
        raise PresetError(f"{path} is no valid TOML: {error}.") from error
    if name not in content:
        raise PresetError(f"Expected a section [{name}] in {path}, got {sorted(content)}.")
    section: dict[str, Any] = content[name]
    return section
