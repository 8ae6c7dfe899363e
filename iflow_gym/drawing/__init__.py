"""Draw your own motion: a page in the browser, served from and to this machine alone.

A motion is drawn a few times with mouse, pen or finger, and fitted; the page shows the streamlines
of what was learned within seconds, and points that are dropped on it run as the system makes them.

    from iflow_gym.drawing import serve
    serve()                               # or: python -m iflow_gym.drawing

Needs the extra ``draw``. `strokes`, `motion` and `saving` do without it.
"""

from __future__ import annotations

from iflow_gym.drawing.server import ServingError, serve
from iflow_gym.drawing.training_steps import TrainingSteps

__all__ = ["ServingError", "TrainingSteps", "serve"]
