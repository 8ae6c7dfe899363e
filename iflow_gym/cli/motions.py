"""Motions and models as commands name them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from iflow_gym.cli.console import PIPE, UsageError, input_bytes, input_path

if TYPE_CHECKING:
    from iflow_gym.demonstrations import Demonstrations
    from iflow_gym.system import Method

OWN = "iflow/PointMass-v0"
"""The environment of one's own demonstrations."""


def environment_id(name: str) -> str | None:
    """Return the id of an environment of the suite by its id or its short name; None if none is."""
    import gymnasium

    import iflow_gym  # noqa: F401 (registers them)

    for candidate in (name, f"iflow/{name}", f"iflow/{name}-v0"):
        if candidate in gymnasium.registry and candidate.startswith("iflow/"):
            if candidate == OWN:
                raise UsageError(
                    f"Expected a motion, got {name}, the environment of one's own demonstrations: "
                    "give the file that `iflow-gym import` wrote instead."
                )
            return candidate
    return None


def load_motion(name: str) -> tuple[Demonstrations, str | None]:
    """Return the demonstrations of a file, of ``-``, or of an environment, and that one's id."""
    from iflow_gym.demonstration_files import (
        demonstrations_from_bytes,
        load_demonstrations,
    )

    if name == PIPE:
        return demonstrations_from_bytes(input_bytes(), "standard input").demonstrations, None
    if not Path(name).exists() or Path(name).is_dir():
        env_id = environment_id(name)
        if env_id is None:
            raise UsageError(_unknown(name))
        import gymnasium

        env = gymnasium.make(env_id, disable_env_checker=True).unwrapped
        return env.demonstrations, env_id  # type: ignore[attr-defined]
    return load_demonstrations(name), None


def _unknown(name: str) -> str:
    from iflow_gym.registration import did_you_mean, registered_ids

    came = "a folder" if name and Path(name).is_dir() else "neither"
    return (
        f"Expected a motion, a file that `iflow-gym import` wrote or an environment of `iflow-gym "
        f"envs`, got {name!r}, which is {came}.{did_you_mean(name, registered_ids())}"
    )


def load_method_class(name: str) -> type[Method]:
    """Return the class of a registered method or of ``module:Class``; UsageError for neither."""
    from iflow_gym.baselines.registry import UnknownNameError, load_method

    try:
        return load_method(name)
    except UnknownNameError as error:
        raise UsageError(str(error)) from error


def load_model_file(path: str, method: str | None) -> tuple[Method, dict[str, object] | None]:
    """Return the model of a file or of ``-``, and what is known of its fit."""
    from iflow_gym.saved_models import inspect_model, load_model

    if method is not None:
        load_method_class(method)  # another name is the command's fault, not the file's
    with input_path(path) as file:
        return load_model(file, method=method), inspect_model(file).fit
