# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Runs scenes: ``python -m stress.worker`` takes number and seed on its input, one scene a line.

For each it prints one line, a JSON object, to the file descriptor that is its standard output
at the start; whatever else is printed goes to its standard error.
"""

from __future__ import annotations

import gc
import json
import os
import sys
import time
import traceback
import warnings

from mpi4py import MPI
from petsc4py import PETSc

from stress import build, checks, generator

import mpm_dolfinx as mpm

OUTCOMES = ("completed", "stopped", "silent", "crashed", "hung")


def run(scene, comm=MPI.COMM_WORLD):
    """Run a scene and return what became of it (collective).

    ``outcome`` is ``completed`` (or refused, as folded input must be); ``stopped`` (by an error of
    the package, with the last converged state whole); ``silent`` (converged, but a check fails,
    whether it stopped later or not); or ``crashed`` (another error, or a state that the failure
    has changed).
    """
    start = time.process_time()
    result = {"number": scene["number"], "class": scene["class"], "steps": 0}
    observer = problem = None
    error = None
    complaints: list[str] = []
    try:
        try:
            made = build.make(scene, comm)
            problem = made.problem
            observer = checks.Observer(scene, made)
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", message="The run ")
                ends = {"steps": scene["steps"]} if made.time is None else made.time
                for _ in problem.steps(**ends, update=made.update):
                    observer.step()
                if made.second is not None:
                    for _ in problem.steps(scene["second_steps"], update=made.second):
                        observer.step()
        except mpm.MPMError as failure:
            error = failure
        if observer is not None:
            changed = observer.changes()
            complaints, figures = observer.judge()
            result |= {"steps": observer.steps, "figures": figures}
            history = problem.history
            result |= {"iterations": history.total_iterations, "cutbacks": history.cutbacks}
            if changed:
                result |= {"outcome": "crashed", "reason": f"changed: {', '.join(changed)}"}
            elif complaints:
                result |= {"outcome": "silent", "reason": "; ".join(complaints)}
            if error is None and history.stopped is not None:
                error = history.stopped
        if "fold" in scene and "outcome" not in result:
            named = any(word in str(error) for word in ("folded", "lie on a neighbour"))
            refused = problem is None and named
            given = f"a folded {scene['fold']} was not refused when the problem was made"
            result |= {"outcome": "completed" if refused else "silent"}
            result |= {"reason": f"refused: {error}" if refused else given}
        if "outcome" not in result:
            if error is None:
                result |= {"outcome": "completed", "reason": ""}
            else:
                reason = f"{type(error).__name__}: {error}"
                result |= {"outcome": "stopped", "reason": reason, "load": error.load}
    except Exception as failure:
        # What is no error of the package is a defect, whatever it is.
        frame = traceback.extract_tb(failure.__traceback__)[-1]
        place = f"{os.path.basename(frame.filename)}:{frame.lineno}"
        reason = f"{type(failure).__name__}: {failure} ({place})"
        result |= {"outcome": "crashed", "reason": reason}
        traceback.print_exc()
    result["seconds"] = round(time.process_time() - start, 3)
    return result


def main() -> None:
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    for line in sys.stdin:
        answer = run(generator.scene(*map(int, line.split())))
        gc.collect()
        PETSc.garbage_cleanup()
        answers.write(json.dumps(answer) + "\n")
        answers.flush()


if __name__ == "__main__":
    main()
