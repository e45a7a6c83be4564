#!/usr/bin/env bash
# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
#
# usage: run_tests.sh [--all] [ARGUMENT OF PYTEST...]
#
# Run the tests of the environment $VENV on one rank, then on each number of ranks of the list
# $NP (default: 2 3, with --all 2 3 4; 1 is no more than the first run). The first run that fails ends
# it. The last line is pytest's summary, after launchers' messages too. $TEST_TIMEOUT is the time
# limit of each run in seconds; $MPIRUN another launcher. The run of everything on one rank is shared
# out among two processes, where pytest-xdist is installed.
#
# Without --all, tests marked slow are left out, and several ranks run where they have something to do
# with each other (between_ranks in tests/marks.py says which tests that are), more than two where
# these are the subject, in the rooms with the most of it. Arguments, such as a folder, are run in full on all ranks.
set -uo pipefail

cd "$(dirname "$0")/.." || exit 1
venv=${VENV:-.venv}
limit=${TEST_TIMEOUT:-1800}
export OMP_NUM_THREADS=1

# Which tests, besides those that are named; on several ranks; and on more ranks than two.
which=() several=() few=()
default="2 3"
if [[ ${1:-} == --all ]]; then
    shift
    which=(-m "")
    default="2 3 4"
    if (($# == 0)); then # no rank hears of another there, or programs run that the first run has had
        several=(--ignore=tests/materials --ignore=tests/benchmarks --ignore=tests/demos)
    fi
elif (($# == 0)); then
    several=(--between-ranks)
    # (Signals, forms and communicators have been asked on two, and take seconds each.)
    few=(parallel/test_{balance,bisection,boundary,exchange,given,refused_calls}.py
        background meshes particles physics/test_parallel.py problems/test_fields.py)
    few=("${few[@]/#/tests/}")
    echo "The quick tests. Those of one folder or file take seconds: make test ARGS=tests/materials," \
        "NP=1 for one rank alone; make test-all runs all, also on four ranks."
fi

read -ra numbers <<<"${NP:-$default}"
for ranks in "${numbers[@]}"; do
    if [[ ! $ranks =~ ^[1-9][0-9]*$ ]]; then
        echo "NP=\"${NP}\" is no list of numbers of ranks, such as \"2 3\"." >&2
        exit 1
    fi
done

# pytest's last line, also with -q
summary_line='^(=+ )?(no tests ran|[0-9]+ (passed|failed|skipped|deselected|xfailed|xpassed|warning|error)).* in [0-9.]+s'

log=$(mktemp)
trap 'rm -f "$log"' EXIT

run() {
    local status=0 summary
    local -a timeout=()
    if command -v timeout >/dev/null; then
        timeout=(timeout --foreground --kill-after=15 "$limit")
    fi
    "${timeout[@]}" "$@" 2>&1 </dev/null | tee "$log" || status=$?
    if ((status != 0)); then
        summary=$(grep -E "$summary_line" "$log" | tail -n 1)
        if ((status == 124 || status == 137)); then
            echo "The run was stopped: it took more than $limit s (TEST_TIMEOUT)."
        fi
        if [[ -z $summary ]]; then
            echo "pytest ended without a summary (status $status): a test crashed or hung, see above."
        elif [[ $summary != "$(tail -n 1 "$log")" ]]; then
            echo "$summary"
        fi
        exit "$status"
    fi
}

cores=$(env -u OMP_NUM_THREADS nproc) # which it would say instead
processes=()
if (($# == 0 && cores > 1)) && "$venv/bin/python" -c 'import xdist' 2>/dev/null; then
    processes=(-n 2 --dist worksteal)
fi
MPM_DOLFINX_RANKS=1 run "$venv/bin/python" -m pytest "${processes[@]}" "${which[@]}" "$@"

# Open MPI refuses more ranks than cores unless it is told so.
export PRTE_MCA_rmaps_default_mapping_policy=:oversubscribe

launcher=("$venv/bin/mpirun")
if [[ -n ${MPIRUN:-} ]]; then
    read -ra launcher <<<"$MPIRUN"
elif [[ ! -x ${launcher[0]} ]]; then
    launcher=(mpirun)
fi
for ranks in "${numbers[@]}"; do
    ((ranks > 1)) || continue
    waiting=() chosen=()
    if ((ranks > cores)); then
        # Ranks that wait leave the cores to the others. (MPICH's heavy yield makes any run with a
        # core to spare ten times slower.)
        waiting=(env MPIR_CVAR_CH4_PROGRESS_THROTTLE=1
            MPIR_CVAR_CH4_PROGRESS_THROTTLE_NO_PROGRESS_COUNT=20 OMPI_MCA_mpi_yield_when_idle=1)
    fi
    ((ranks == 2)) || chosen=("${few[@]}")
    MPM_DOLFINX_RANKS=$ranks run "${waiting[@]}" "${launcher[@]}" -n "$ranks" \
        "$venv/bin/python" -m pytest -p no:cacheprovider "${which[@]}" "${several[@]}" "${chosen[@]}" "$@"
done
