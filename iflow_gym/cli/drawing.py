"""``iflow-gym draw``: a page on which a motion is drawn, fitted and watched."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from iflow_gym.cli.console import complain


@dataclass(frozen=True)
class Draw:
    """Draw a motion in the browser, fit it, and watch it run.

    The page is served on the loopback address alone. What is saved goes into the directory: the
    demonstrations as CSV, which `iflow-gym import` reads, and the model. Needs the extra draw.

        iflow-gym draw
        iflow-gym draw --port 0 --no-open --directory my-motions
    """

    port: int = 8765
    """Port of 127.0.0.1; 0 takes any that is free."""
    open_browser: Annotated[bool, arg(name="open")] = True
    """Open the page in the browser."""
    directory: Path = Path("drawings")
    """Folder for what is saved."""

    def run(self) -> int:
        """Serve until it is ended."""
        from iflow_gym.drawing import ServingError, serve

        try:
            serve(self.port, self.open_browser, self.directory)
        except ServingError as error:
            complain(str(error))
            return 1
        return 0
