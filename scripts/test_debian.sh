#!/usr/bin/env bash
# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
#
# usage: test_debian.sh [ARGUMENT OF PYTEST...]
#
# Run all tests with Debian's own DOLFINx, on one rank, then on $NP ranks, in a root made by
# debootstrap: its first use takes some minutes and 4 GB, later ones use it as it is. Needs to be
# run by root. Everything is Debian's but pytest, which pip brings where Debian's is too old.
#
#   DEBIAN_ROOT    where the root is      (default: /var/tmp/mpm-dolfinx-SUITE)
#   DEBIAN_SUITE   Debian's release       (default: trixie, with DOLFINx 0.9 and PETSc 3.22)
#   DEBIAN_MIRROR  where it comes from    (default: where this machine's apt has Debian from, else
#                                          debootstrap's own)
#   NP, TEST_TIMEOUT                      as for run_tests.sh
set -euo pipefail

cd "$(dirname "$0")/.."
suite=${DEBIAN_SUITE:-trixie}
root=${DEBIAN_ROOT:-/var/tmp/mpm-dolfinx-$suite}
# The first of apt's sources that is Debian itself, which others may stand before.
mirror=${DEBIAN_MIRROR:-$(apt-get indextargets --format '$(ORIGIN)|$(LABEL)|$(REPO_URI)' 2>/dev/null |
    sed -n 's/^Debian|Debian|//p' | head -n 1)}
venv=/opt/mpm-dolfinx
packages="python3-dolfinx-real python3-gmsh python3-matplotlib python3-pyvista python3-scipy
python3-tqdm python3-pip python3-venv python3-dev python3-nanobind nanobind-dev
python3-scikit-build-core cmake ninja-build g++ mpi-default-bin ca-certificates libegl1"

fail() {
    echo "$*" >&2
    exit 1
}

[ "$(id -u)" = 0 ] ||
    fail "make test-debian makes and enters a Debian root, which only root may do: sudo make test-debian"
command -v unshare >/dev/null ||
    fail "make test-debian needs the command unshare: install util-linux."

# In the root, with a mount namespace of its own, so that nothing stays mounted.
enter() {
    # shellcheck disable=SC2016  # for the inner shell
    unshare --mount --propagation private sh -c '
        root=$1
        shift
        mount -t proc proc "$root/proc" && mount --rbind /sys "$root/sys" &&
            mount --rbind /dev "$root/dev" || {
            echo "The file systems of $root cannot be mounted here (in a container?)." >&2
            exit 1
        }
        exec chroot "$root" "$@"' sh "$root" env -i \
        PATH="$venv/bin:/usr/sbin:/usr/bin:/sbin:/bin" HOME=/root LC_ALL=C.UTF-8 \
        DEBIAN_FRONTEND=noninteractive PIP_DISABLE_PIP_VERSION_CHECK=1 \
        PIP_CERT=/etc/ssl/certs/ca-certificates.crt ${PIP_INDEX_URL:+PIP_INDEX_URL="$PIP_INDEX_URL"} \
        http_proxy="${http_proxy:-}" https_proxy="${https_proxy:-}" no_proxy="${no_proxy:-}" \
        OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1 "$@"
}

if [ ! -e "$root" ]; then
    command -v debootstrap >/dev/null ||
        fail "make test-debian needs the command debootstrap: apt-get install debootstrap, or name a Debian root that exists with DEBIAN_ROOT=."
    echo "Making a root of Debian $suite in $root from ${mirror:-where debootstrap finds it}"
    rm -rf "$root.part"
    debootstrap --variant=minbase "$suite" "$root.part" ${mirror:+"$mirror"} >"$root.log" 2>&1 ||
        fail "debootstrap failed; see $root.log. Is ${mirror:-its mirror} reached from here? Name another with DEBIAN_MIRROR=."
    mv "$root.part" "$root"
    rm -f "$root.log"
fi
grep -qsx "VERSION_CODENAME=$suite" "$root/etc/os-release" ||
    fail "$root is no root of Debian $suite: remove it, or name another with DEBIAN_ROOT=."

# Names and certificates that this machine knows, for apt and pip.
cp -L /etc/resolv.conf "$root/etc/resolv.conf"
if [ "$(cat "$root$venv/packages" 2>/dev/null)" != "$packages" ]; then
    echo "Installing Debian's packages in $root (the first time this takes some minutes)"
    # shellcheck disable=SC2086  # a list of words
    { enter apt-get -qq update && enter apt-get -qq install -y --no-install-recommends $packages; } \
        >"$root/packages.log" 2>&1 || fail "apt-get failed in $root; see $root/packages.log."
    enter python3 -m venv --system-site-packages "$venv"
    echo "$packages" >"$root$venv/packages"
fi
if [ -e /etc/ssl/certs/ca-certificates.crt ]; then
    cp -L /etc/ssl/certs/ca-certificates.crt "$root/etc/ssl/certs/ca-certificates.crt"
fi

# A copy of the tree, with the compiled loops built in the root.
rm -rf "$root/src"
mkdir "$root/src"
if git rev-parse --is-inside-work-tree >/dev/null 2>&1; then
    git ls-files --cached --others --exclude-standard -z
else
    find . -type f -not -path './.*' -print0
fi | tar --create --null --ignore-failed-read --files-from=- | tar --extract --directory "$root/src"

in_source() {
    enter env --chdir=/src OMP_NUM_THREADS=1 VENV="$venv" NP="${NP:-2}" \
        ${TEST_TIMEOUT:+TEST_TIMEOUT="$TEST_TIMEOUT"} "$@"
}
oldest=$(sed -n 's/^minversion = "\(.*\)"/\1/p' pyproject.toml)
in_source pip install --quiet "pytest>=$oldest"
in_source pip install --quiet --no-deps --no-build-isolation --editable .
in_source python -c '
import mpm_dolfinx
import dolfinx
from petsc4py import PETSc
petsc = ".".join(map(str, PETSc.Sys.getVersion()))
print(f"DOLFINx {dolfinx.__version__}, PETSc {petsc}")'
in_source bash scripts/run_tests.sh "$@"
