"""What a model was fitted on, kept in its file beside its parameters.

A score has to know it to be one of recordings that the model has not seen. It is read by
`inspect_model`.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from iflow_gym.saved_models import FIT_KEY


def add_fit_record(path: str | os.PathLike[str], record: Mapping[str, Any]) -> None:
    """Put a record, of what JSON holds, into a model file that `save` wrote.

    The file is replaced as a whole; its arrays keep their bytes.
    """
    file = Path(path)
    content = file.read_bytes()
    length = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + length])
    header["__metadata__"][FIT_KEY] = json.dumps(dict(record), sort_keys=True)
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    partial = file.with_name(f"{file.name}.{os.getpid()}.partial")
    partial.write_bytes(len(text).to_bytes(8, "little") + text + content[8 + length :])
    partial.replace(file)
