#!/usr/bin/env bash
# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
#
# usage: test_wheel.sh [WHEEL]
#
# Install a wheel (default: that of dist/) with DOLFINx into an environment of its own, outside of
# this tree, and from there run what a user would: the example of the README, and some of the tests.
# $PYTHON names the interpreter.
set -euo pipefail

cd "$(dirname "$0")/.."
tree=$(pwd)
wheel=$(realpath "${1:-$(echo dist/*.whl)}")
python=${PYTHON:-$(sh scripts/find_python.sh)}
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
export OMP_NUM_THREADS=1

"$python" -m venv "$place/env"
"$place/env/bin/python" -m pip install --quiet --disable-pip-version-check "$wheel[wheel]" "pytest>=9" scipy
mkdir "$place/run"
cp -r tests "$place/run/tests"
cp pyproject.toml "$place/run"
sed -n '/^```python$/,/^```$/{/^```/d;p}' README.md >"$place/run/readme.py"
cd "$place/run"

TREE=$tree "$place/env/bin/python" - <<'EOF'
import os
from importlib.metadata import version
from pathlib import Path

import mpm_dolfinx

where = Path(mpm_dolfinx.__file__)
assert not where.is_relative_to(os.environ["TREE"]), where
assert version("mpm-dolfinx") == mpm_dolfinx.__version__
print(f"mpm_dolfinx {mpm_dolfinx.__version__} in {where.parent}")
EOF
"$place/env/bin/python" readme.py
ls column.pvd
"$place/env/bin/python" -m pytest -q -p no:cacheprovider tests/materials/test_compiled.py \
    tests/assembly/test_loads.py tests/physics/test_units.py tests/stepping/test_stages.py
