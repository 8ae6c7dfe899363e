"""The commands, and how a line is parsed into one of them."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Annotated, Any, Union, get_args, get_type_hints

import tyro
from tyro.conf import DisallowNone, OmitSubcommandPrefixes, subcommand

from iflow_gym.cli.board import Leaderboard
from iflow_gym.cli.console import Command
from iflow_gym.cli.datasets import Data
from iflow_gym.cli.drawing import Draw
from iflow_gym.cli.environments import Envs
from iflow_gym.cli.exporting import Export
from iflow_gym.cli.fitting import Fit, Methods
from iflow_gym.cli.helping import say_in_help
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


def parse(
    arguments: list[str],
    description: str,
    commands: Mapping[str, type[Any]] = COMMANDS,
    prog: str = "iflow-gym",
) -> Command:
    """Return the command of a line; prints help, or what was not understood, and exits."""
    command: Command
    name = arguments[0] if arguments else ""
    if name in commands:  # its own help in full, and no time for the others
        cls = commands[name]
        if group := _subcommands(cls):
            return parse(arguments[1:], inspect.getdoc(cls) or "", group, f"{prog} {name}")
        say_in_help(cls)
        command = tyro.cli(
            cls,
            prog=f"{prog} {name}",
            args=arguments[1:],
            config=(OmitSubcommandPrefixes, DisallowNone),
            use_underscores=False,
        )
        return command
    choices = tuple(
        Annotated[cls, subcommand(name, description=_summary(cls))]
        for name, cls in commands.items()
    )
    command = tyro.cli(  # type: ignore[call-overload]
        Union[choices],  # noqa: UP007 (made of a table)
        prog=prog,
        description=description,
        args=arguments,
        config=(OmitSubcommandPrefixes, DisallowNone),
        use_underscores=False,
    )
    return command


def _subcommands(cls: type[Any]) -> dict[str, type[Any]]:
    """Return the commands of a group, which are the alternatives of its field `command`."""
    alternatives = get_args(get_type_hints(cls, include_extras=True).get("command"))
    return {part.__metadata__[0].name: part.__origin__ for part in alternatives}


def _summary(cls: type) -> str:
    """Return the first sentence of a docstring."""
    text = " ".join((cls.__doc__ or "").split("\n\n")[0].split())
    return text.partition(": ")[0].rstrip(".") + "."
