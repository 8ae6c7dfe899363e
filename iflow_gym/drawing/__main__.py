"""Draw a motion in the browser, fit it, and watch it run.

    python -m iflow_gym.drawing
    python -m iflow_gym.drawing --port 0 --no-open --directory my-motions

The page is served on the loopback address alone. What is saved goes into the directory: the
demonstrations as CSV, the model as a model file.

Exit status: 0 when it is ended, 1 when it cannot be served.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from iflow_gym.drawing.server import DEFAULT_DIRECTORY, DEFAULT_PORT, ServingError, serve
from iflow_gym.drawing.training_steps import TrainingSteps


def draw(
    port: int = DEFAULT_PORT,
    open_browser: Annotated[bool, arg(name="open")] = True,
    directory: Path = Path(DEFAULT_DIRECTORY),
    steps: TrainingSteps = TrainingSteps(),  # noqa: B008 (frozen)
) -> int:
    """Draw a motion.

    Parameters
    ----------
    port
        Port of 127.0.0.1; 0 takes any that is free.
    open_browser
        Open the page in the browser.
    directory
        Folder for what is saved.
    steps
        How long ImitationFlow is trained.
    """
    try:
        serve(port, open_browser, directory, steps=steps)
    except ServingError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


def main() -> None:
    """Run from the command line."""
    import tyro

    sys.exit(
        tyro.cli(
            draw, prog="python -m iflow_gym.drawing", description=__doc__, use_underscores=False
        )
    )


if __name__ == "__main__":
    main()
