"""The snippets of a Markdown file: `python snippets.py README.md 0` prints the first of Python."""

import re
import sys
from pathlib import Path


def snippets(path, language):
    """Return the text of every block in a language, in order."""
    return re.findall(rf"^```{language}\n(.*?)^```$", Path(path).read_text(), flags=re.M | re.S)


def python_snippets(path):
    """Return the text of every ```python block, in order."""
    return snippets(path, "python")


if __name__ == "__main__":
    print(python_snippets(sys.argv[1])[int(sys.argv[2])])
