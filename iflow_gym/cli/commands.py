"""The commands, and how a line is parsed into one of them."""

from __future__ import annotations

from typing import Annotated, Union

import tyro
from tyro.conf import DisallowNone, OmitSubcommandPrefixes, subcommand

from iflow_gym.cli.board import Leaderboard
from iflow_gym.cli.console import Command
from iflow_gym.cli.datasets import Data
from iflow_gym.cli.drawing import Draw
from iflow_gym.cli.environments import Envs
from iflow_gym.cli.exporting import Export
from iflow_gym.cli.fitting import Fit, Methods
from iflow_gym.cli.importing import Import
from iflow_gym.cli.plotting import Plot
from iflow_gym.cli.rolling import Rollout
from iflow_gym.cli.scoring import Score

COMMANDS = {
    "envs": Envs,
    "data": Data,
    "import": Import,
    "methods": Methods,
    "fit": Fit,
    "score": Score,
    "rollout": Rollout,
    "plot": Plot,
    "export": Export,
    "draw": Draw,
    "leaderboard": Leaderboard,
}
"""By name, in the order of the help."""


def parse(arguments: list[str], description: str) -> Command:
    """Return the command of a line; prints help, or what was not understood, and exits."""
    command: Command
    name = arguments[0] if arguments else ""
    if name in COMMANDS:  # its own help in full, and no time for the others
        command = tyro.cli(
            COMMANDS[name],
            prog=f"iflow-gym {name}",
            args=arguments[1:],
            config=(OmitSubcommandPrefixes, DisallowNone),
            use_underscores=False,
        )
        return command
    choices = tuple(
        Annotated[cls, subcommand(name, description=_summary(cls))]
        for name, cls in COMMANDS.items()
    )
    command = tyro.cli(  # type: ignore[call-overload]
        Union[choices],  # noqa: UP007 (made of a table)
        prog="iflow-gym",
        description=description,
        args=arguments,
        config=(OmitSubcommandPrefixes, DisallowNone),
        use_underscores=False,
    )
    return command


def _summary(cls: type) -> str:
    """Return the first sentence of a docstring."""
    text = " ".join((cls.__doc__ or "").split("\n\n")[0].split())
    return text.partition(": ")[0].rstrip(".") + "."
