# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Kill a run that checkpoints each step, at random moments, and see what is left of it.

As a program: ``python tests/stress/kills.py --kills 50 --ranks 1``.
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

HERE = Path(__file__).parent
STEPS = 20


def child(path):
    """Run a slumping column to its end, from the checkpoint if there is one."""
    from mpi4py import MPI

    import numpy as np
    import scenes

    comm = MPI.COMM_WORLD

    def say(word, *values):
        if comm.rank == 0:
            sys.stdout.write(" ".join(map(str, (word, *values))) + "\n")  # in one piece
            sys.stdout.flush()

    problem = scenes.slump(scenes.TRIANGLE, 20e3, h=1.0)
    if path.exists():
        problem.restore(path)
    say("pids", *comm.gather(os.getpid()) or [])
    say("begin", len(problem.history.steps))
    for _ in problem.steps(STEPS):
        problem.save(path)
        say("saved", len(problem.history.steps))
    particles = problem.particles
    values = [scenes.in_order(particles, getattr(particles, k)) for k in ("centroid", "stress")]
    say("end", json.dumps([*problem.history.load, *np.concatenate([v.ravel() for v in values])]))


def launch(path, ranks):
    """Start the child; return it and the ids of its ranks' processes."""
    launcher = [str(Path(sys.executable).parent / "mpirun"), "-n", str(ranks)] if ranks > 1 else []
    process = subprocess.Popen(
        [*launcher, sys.executable, str(HERE / "kills.py"), "--child", str(path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env={
            **os.environ,
            "PYTHONPATH": os.pathsep.join([str(HERE.parent), *filter(None, sys.path)]),
        },
    )
    return process, [int(p) for p in process.stdout.readline().split()[1:]]


def finish(process):
    """Let a run come to its end; return what it said there, and with how many steps it began."""
    lines = process.stdout.read().splitlines()
    assert process.wait() == 0
    assert lines[-1].startswith("end ")
    return json.loads(lines[-1].split(" ", 1)[1]), int(lines[0].split()[1])


def kill(path, ranks, known, moment):
    """Start a run and kill it after some seconds.

    Returns:
        How many steps are known to be saved, and whether the run was at its end before.
    """
    process, pids = launch(path, ranks)
    time.sleep(moment)
    for pid in pids:
        with suppress(ProcessLookupError):  # the launcher ends the others
            os.kill(pid, signal.SIGKILL)
    *lines, _ = process.stdout.read().split("\n")  # the last one may be cut off
    process.wait()
    for line in lines:
        word, *values = line.split(" ", 1)
        if word == "begin":
            # What had been saved is there, and at most one step more: the one in flight.
            assert known <= int(values[0]) <= known + 1, (known, lines)
        if word in ("begin", "saved"):
            known = int(values[0])
    return known, any(line.startswith("end") for line in lines)


def run(kills, ranks, path, seed=1):
    """Kill runs again and again; each must go on where it was and end as an undisturbed one.

    Returns:
        Number of kills, of runs that came to an end, and the largest difference of their results.
    """
    dice = random.Random(seed)
    process, _ = launch(path, ranks)
    start = time.monotonic()
    reference, _ = finish(process)
    step = (time.monotonic() - start) / STEPS
    done = ended = 0
    worst = 0.0
    while done < kills:
        path.unlink(missing_ok=True)
        known, at_end = 0, False
        while done < kills and not at_end:
            known, at_end = kill(path, ranks, known, dice.uniform(0.0, 6.0) * step)
            done += 1
        process, _ = launch(path, ranks)
        result, begun = finish(process)
        assert known <= begun <= known + 1
        ended += 1
        assert len(result) == len(reference)
        scale = max(map(abs, reference))
        gap = max(abs(a - b) for a, b in zip(result, reference, strict=True)) / scale
        worst = max(worst, gap)
    return done, ended, worst


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Kill runs that checkpoint each step.")
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--ranks", type=int, default=1)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--child", type=Path, help="run to the end, from this checkpoint on")
    args = parser.parse_args()
    if args.child:
        child(args.child)
    else:
        with tempfile.TemporaryDirectory() as folder:
            done, ended, worst = run(args.kills, args.ranks, Path(folder) / "run.ckpt", args.seed)
        print(f"{done} kills on {args.ranks} rank(s), {ended} runs ended, difference {worst:.1e}")
