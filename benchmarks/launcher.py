# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Scripts on several ranks, in processes of their own."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

#: With more ranks than cores, ranks that wait leave them the cores (MPICH, Open MPI).
WAITING = {
    "MPIR_CVAR_CH4_PROGRESS_THROTTLE": "1",
    "MPIR_CVAR_CH4_PROGRESS_THROTTLE_NO_PROGRESS_COUNT": "20",
    "OMPI_MCA_mpi_yield_when_idle": "1",
    "PRTE_MCA_rmaps_default_mapping_policy": ":oversubscribe",
}


def launched(ranks: int, script: Path, *arguments: str) -> dict[str, Any]:
    """Run a script that prints a JSON object, and return that.

    Args:
        ranks: Number of ranks.
        script: The script.
        *arguments: Its arguments.

    Raises:
        SystemExit: There is no ``mpirun``, or the script fails.
    """
    beside = Path(sys.executable).with_name("mpirun")
    mpirun = str(beside) if beside.exists() else shutil.which("mpirun")
    if mpirun is None:
        raise SystemExit("There is no mpirun, neither beside this Python nor on PATH.")
    cores = len(os.sched_getaffinity(0))
    done = subprocess.run(
        [mpirun, "-n", str(ranks), sys.executable, str(script), *arguments],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1", **(WAITING if ranks > cores else {})},
    )
    if done.returncode != 0:
        what = " ".join([script.name, *arguments])
        raise SystemExit(f"{what} failed on {ranks} ranks:\n{done.stderr}")
    return dict(json.loads(done.stdout))
