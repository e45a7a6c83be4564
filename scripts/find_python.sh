#!/bin/sh
# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
#
# Print the path of a Python >= 3.12 that can make virtual environments: $PYTHON where it is
# set, else the first that works on PATH, else one of pyenv's. Each candidate is run, because
# a name on PATH may be a shim that fails.
set -u

check='
import sys
if sys.version_info < (3, 12) or sys.implementation.name != "cpython":
    sys.exit(1)
import ensurepip, ssl, venv, zlib
print(sys.executable)
'

try() {
    found=$("$1" -c "$check" 2>/dev/null </dev/null) && [ -n "$found" ] || return 1
    printf '%s\n' "$found"
    exit 0
}

if [ -n "${PYTHON:-}" ]; then
    try "$PYTHON"
    echo "PYTHON=$PYTHON cannot be used: it does not run, is older than 3.12, or lacks the modules venv and ensurepip." >&2
    exit 1
fi

for name in python3.14 python3.13 python3.12 python3; do
    try "$name"
done

for root in "$(pyenv root 2>/dev/null)" "${PYENV_ROOT:-}" "${HOME:-}/.pyenv"; do
    [ -d "$root/versions" ] || continue
    for version in 3.14 3.13 3.12 ""; do
        for candidate in "$root/versions/$version"*/bin/python3; do
            [ -x "$candidate" ] && try "$candidate"
        done
    done
done

echo "No working Python 3.12 or newer with the modules venv and ensurepip was found, neither on PATH (python3.14, python3.13, python3.12, python3) nor among pyenv's versions. Install one, or name one: make PYTHON=/path/to/python3 ..." >&2
exit 1
