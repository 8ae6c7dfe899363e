"""The Python snippets of a Markdown file: `python snippets.py README.md 0` prints the first."""

import re
import sys
from pathlib import Path


def python_snippets(path):
    """Return the text of every ```python block, in order."""
    return re.findall(r"^```python\n(.*?)^```$", Path(path).read_text(), flags=re.M | re.S)


if __name__ == "__main__":
    print(python_snippets(sys.argv[1])[int(sys.argv[2])])
