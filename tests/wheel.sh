#!/usr/bin/env bash
# Build the wheel, install it into an empty environment, and run the README's first snippet there
# from a neutral folder: what a user of `pip install` gets, without this checkout in sight.
set -euo pipefail
here=$(cd "$(dirname "$0")/.." && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
# From a copy: a build writes beside its sources, and tests may be running there.
mkdir "$work/sources"
cd "$here"
if git ls-files -z >"$work/files" 2>/dev/null; then
    tar --null -T "$work/files" -cf "$work/sources.tar"
else # no repository, but what one holds
    tar --exclude=./.venv --exclude=./results -cf "$work/sources.tar" .
fi
tar -xf "$work/sources.tar" -C "$work/sources"
"$here/${VENV:-.venv}/bin/python" -m build --quiet --wheel --outdir "$work/dist" "$work/sources"
if unzip -l "$work"/dist/*.whl 2>/dev/null | grep -qE '\.mat$'; then
    echo "The wheel carries LASA's data." >&2
    exit 1
fi
"${PYTHON:-python3}" -m venv "$work/venv"
"$work/venv/bin/python" -m pip install --quiet --constraint "$here/constraints.txt" "$work"/dist/*.whl
"$here/${VENV:-.venv}/bin/python" "$here/tests/docs/snippets.py" "$here/README.md" 0 > "$work/snippet.py"
cd "$work"
"$work/venv/bin/python" snippet.py
echo "The wheel works: $(basename "$work"/dist/*.whl)"
