"""The command ``iflow-gym``: from a recording to a policy, and what belongs to it.

Each command is a frozen dataclass in a module of its own, whose fields are its arguments and whose
`run` does the work and returns the exit status. What is heavy is imported in `run`, so that help
and completion come at once.
"""

from __future__ import annotations

import os
import re
import sys
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from iflow_gym.cli.console import Command

DESCRIPTION = """\
From a recording of a motion to a policy that is stable, scored and exported.

    iflow-gym import reach.csv --output reach.safetensors --plot reach.png
    iflow-gym fit reach.safetensors --output policy.safetensors
    iflow-gym score policy.safetensors reach.safetensors
    iflow-gym plot reach.safetensors --model policy.safetensors --output field.png
    iflow-gym export policy.safetensors --output policy.onnx

Every command has a --help of its own. Data go to standard output, all talk to standard error, and
- stands for either where a file is asked for.

Exit status: 0 it is done, 1 it could not be done, 2 the command was not understood.
IFLOW_GYM_DEBUG=1 shows where an error came from. --version prints the version.

Completion in bash (or zsh), once:

    iflow-gym --tyro-write-completion bash ~/.local/share/bash-completion/completions/iflow-gym
"""

INTERRUPTED = 130
BROKEN_PIPE = 141
"""What shells report of a process that SIGINT, or SIGPIPE, has ended."""


def main() -> NoReturn:
    """Run from the command line."""
    sys.exit(run(sys.argv[1:]))


def run(arguments: list[str]) -> int:
    """Run a command and return its exit status; errors of the user's are told in a sentence."""
    from iflow_gym.cli.console import UsageError, complain

    if getattr(sys, "stderr", None) is None:  # closed by who called: 2>&-
        sys.stderr = open(os.devnull, "w")  # noqa: SIM115 (until the end)
    command: Command | None = None
    try:
        if os.getcwd() not in sys.path:
            sys.path.append(os.getcwd())  # for --method my_module:MyMethod
        from iflow_gym.cli.commands import parse  # here: an interrupt meets it, too

        if getattr(sys, "stdout", None) is None:
            raise UsageError("Expected a standard output, got a closed one: > /dev/null drops it.")
        if arguments == ["--version"]:
            from iflow_gym import __version__

            print(f"iflow-gym {__version__}", flush=True)
            return 0
        command = parse(arguments, DESCRIPTION)
        status = command.run()
        sys.stdout.flush()
        return status
    except KeyboardInterrupt:
        complain("stopped.")
        return INTERRUPTED
    except BrokenPipeError:
        # Whoever read has read enough; Python would complain once more when it closes the stream.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BROKEN_PIPE
    except UsageError as error:
        return _told(error, 2)
    except (ValueError, OSError, ImportError, MemoryError) as error:
        return _told(error, 1)


def _told(error: BaseException, status: int) -> int:
    from iflow_gym.cli.console import complain

    if os.environ.get("IFLOW_GYM_DEBUG"):
        raise error
    text = str(error) or type(error).__name__
    if isinstance(error, OSError) and error.strerror:
        # What is written is complete under another name first.
        name = re.sub(r"\.\d+\.partial", "", str(error.filename or "the data"))
        text = f"Expected to read or write {name}, got: {error.strerror}."
    complain(text)
    return status
