#!/bin/sh
# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
#
# usage: setup_env.sh EXTRA...
#
# Make the environment $VENV (default .venv) where it is missing, and install this package in
# it, editable, with the extras named. What was installed for which pyproject.toml, modules and
# compiled sources is noted in $VENV/.mpm-dolfinx, after it has succeeded, so that a second call has
# nothing to do, and one with further extras installs what these ask for and no more. What builds the
# package stays in the environment: where sources change, only these are compiled again.
set -eu

cd "$(dirname "$0")/.."
root=$(pwd)
venv=${VENV:-.venv}
state=$venv/.mpm-dolfinx

fail() {
    echo "$*" >&2
    exit 1
}

# What was not made here is not touched.
if [ ! -e "$venv/bin/python" ] && [ ! -e "$state/unfinished" ] && [ ! -e "$state/made-here" ] &&
    [ -n "$(find "$venv" -mindepth 1 -maxdepth 1 ! -name .mpm-dolfinx 2>/dev/null)" ]; then
    fail "$venv is not empty and no Python environment that works (no bin/python): remove it, or name another with VENV=."
fi
mkdir -p "$state"

# One at a time: two calls of pip in one environment spoil it.
if command -v flock >/dev/null 2>&1; then
    exec 9>"$state/lock"
    flock 9
fi

# An environment that was left half made is made again.
if [ ! -e "$venv/bin/python" ] || [ -e "$state/unfinished" ]; then
    if ! python=$(sh scripts/find_python.sh); then
        [ -e "$state/unfinished" ] || rm -rf "$state"
        rmdir "$venv" 2>/dev/null || true
        exit 1
    fi
    echo "Making the environment $venv with $python"
    : >"$state/unfinished"
    rm -f "$state/installed"
    (cd "$venv" && rm -rf bin include lib lib64 pyvenv.cfg)
    # (The interpreter's own pip brings one in less than half the time of ensurepip.)
    "$python" -m venv --without-pip "$venv"
    "$python" -m pip --python "$venv/bin/python" install --quiet --disable-pip-version-check --no-compile \
        pip 2>/dev/null || "$venv/bin/python" -m ensurepip --upgrade --default-pip >/dev/null
    : >"$state/made-here"
    rm -f "$state/unfinished"
fi

py=$venv/bin/python
"$py" -c 'import sys; sys.exit(sys.version_info < (3, 12))' 2>/dev/null </dev/null ||
    fail "The Python of $venv does not run or is older than 3.12: remove $venv, or name another environment with VENV=."

# The editable installation knows the package's files by name.
modules=$(find mpm_dolfinx -name '*.py' | LC_ALL=C sort)
key="$root $({
    echo "$modules"
    cat pyproject.toml CMakeLists.txt mpm_dolfinx/_core/*.cpp mpm_dolfinx/_core/*.h
} | cksum)"
installed=$state/installed
built=no
if [ "$(sed -n 1p "$installed" 2>/dev/null)" = "$key" ]; then
    built=yes
    missing=
    for extra in "$@"; do
        grep -qx "$extra" "$installed" || missing="$missing $extra"
    done
    [ -n "$missing" ] || exit 0
    # shellcheck disable=SC2086  # a list of words
    set -- $missing
fi

# An environment that brings a DOLFINx of its own (conda, apt, source) does without the wheel.
own_dolfinx() {
    [ ! -e "$state/made-here" ] && "$py" -c '
import sys
from importlib.util import find_spec
sys.exit(find_spec("dolfinx") is None or find_spec("dolfinx_solver") is not None)'
}
extras=
compiler=no
for extra in "$@"; do
    if [ "$extra" = wheel ]; then
        compiler=yes
        if own_dolfinx; then
            continue
        fi
    fi
    extras="$extras $extra"
done

# FFCx compiles each form when it is first used.
if [ "$compiler" = yes ]; then
    "$py" -c '
import os, shlex, shutil, sys, sysconfig
cc = os.environ.get("CC") or sysconfig.get_config_var("CC") or "cc"
sys.exit(shutil.which(shlex.split(cc)[0]) is None)' ||
        fail "DOLFINx needs a C compiler at run time and there is none: install gcc."
fi

pip_install() {
    # (Python compiles modules that are imported, when they are: a tenth of them.)
    "$py" -m pip install --quiet --disable-pip-version-check --no-compile "$@"
}

# Install what a file lists, if it lists something.
install_wanted() {
    if grep -q . "$1"; then
        pip_install --requirement "$1"
    fi
}

# Install what pyproject.toml asks for: to build the package (build), for it (package), for extras.
install_for() {
    "$py" - "$@" <<'END' >"$state/${1:-nothing}.txt"
import sys
import tomllib

with open("pyproject.toml", "rb") as file:
    data = tomllib.load(file)
known = data["project"]["optional-dependencies"]
known["package"], known["build"] = data["project"]["dependencies"], data["build-system"]["requires"]
print("\n".join(line for name in sys.argv[1:] for line in known[name]))
END
    install_wanted "$state/${1:-nothing}.txt"
}

# shellcheck disable=SC2086  # a list of words
if [ "$built" = yes ]; then
    echo "Installing what [${extras# }] asks for into $venv"
    install_for $extras
else
    echo "Installing this package with [${extras# }] into $venv (the first time this takes a minute or so)"
    rm -f "$installed"
    install_for build
    # CMake and Ninja, where the machine has none
    "$py" -c '
from scikit_build_core.build import get_requires_for_build_editable
print("\n".join(get_requires_for_build_editable()))' >"$state/build.txt"
    install_wanted "$state/build.txt"
    # What it needs to run is fetched while it is compiled.
    install_for package $extras &
    pip_install --no-build-isolation --no-deps --editable . && status=0 || status=$?
    wait $! || status=$?
    [ "$status" = 0 ] || exit "$status"
fi
case "$extras " in
*" adjoint "*) pip_install --no-deps dolfinx-adjoint fenicsx-compat ;;
esac
{
    echo "$key"
    {
        [ "$built" = no ] || sed 1d "$installed"
        printf '%s\n' "$@"
    } | LC_ALL=C sort -u
} >"$installed.new"
mv "$installed.new" "$installed"
