# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Send Ctrl-C to runs at random moments, and compare what is left with the last converged step.

As a program: ``python tests/stress/interrupts.py --moments 40 --ranks 2``.
"""

import argparse
import os
import random
import signal
import subprocess
import sys
import time
from contextlib import nullcontext
from pathlib import Path

HERE = Path(__file__).parent
STEPS = 12


def whole_state(problem):
    """Return copies of all that the next step depends on (collective)."""
    import numpy as np
    import scenes

    arrays = scenes.state(problem)
    for i, body in enumerate(problem.bodies):
        arrays[f"converged {i}"] = np.array(body.converged_displacement)
        arrays[f"load {i}"] = np.array(body.load.value)
        arrays[f"proportional {i}"] = np.array(body.proportional.value)
    for i, kept in enumerate(problem.converged_state()):
        arrays |= {f"history {i} {name}": c.values.copy() for name, c in kept.items()}
    for i, (size, increments) in enumerate(problem.reduced.predictor.past):
        arrays[f"past {i}"] = np.concatenate([[size], *increments])
    trial = problem.trial
    arrays["prescribed"] = trial.converged.prescribed.copy()
    arrays["experience"] = np.array(trial.newton.experience)
    arrays["steps"] = np.array(problem.history.load)
    return arrays


def scene(**options):
    """Return a column that slumps and yields, in few and hard steps."""
    import scenes

    return scenes.slump(scenes.TRIANGLE, 20e3, h=1.0, **options)


def child():
    """Run the scene until it is interrupted, again and again, from where it was."""
    from mpi4py import MPI

    from mpm_dolfinx.parallel.interruption import held

    comm = MPI.COMM_WORLD
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background ignores it

    def say(word, *values):
        if comm.rank == 0:
            print(word, *values, flush=True)

    problem = scene()
    states = [whole_state(problem)]  # by the number of steps
    states += [whole_state(problem) for _ in problem.steps(STEPS)]
    # On several ranks a signal may come to one of them when the run is over on the other.
    with held() if comm.size > 1 else nullcontext():
        say("pids", *comm.gather(os.getpid()) or [])
        obey(comm, say, states)


def obey(comm, say, states):
    """Make runs as one is told to on the standard input."""
    import scenes

    from mpm_dolfinx.parallel.interruption import settle

    while comm.bcast(sys.stdin.readline() if comm.rank == 0 else None):
        settle(comm)
        problem = scene()
        kept = whole_state(problem)
        say("begin")
        try:
            for _ in problem.steps(STEPS):
                if comm.size > 1:  # else Ctrl-C may come here too; the states are always the same
                    kept = whole_state(problem)
        except KeyboardInterrupt:
            word = "interrupted"
        else:
            word = "complete"
        if comm.size == 1:
            kept = states[len(problem.history.steps)]
        scenes.assert_same_state(kept, whole_state(problem))
        assert comm.size > 1 or signal.getsignal(signal.SIGINT) is signal.default_int_handler
        begun = len(problem.history.load)
        if word == "interrupted" and begun % 3 == 1:  # it can go on
            next(problem.steps(STEPS))
            assert len(problem.history.load) == begun + 1
        assert len(set(comm.allgather(word))) == 1
        say(word, begun)


def launch(ranks):
    """Start the child; return it and the ids of its ranks' processes."""
    launcher = [str(Path(sys.executable).parent / "mpirun"), "-n", str(ranks)] if ranks > 1 else []
    process = subprocess.Popen(
        [*launcher, sys.executable, str(HERE / "interrupts.py"), "--child"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={
            **os.environ,
            "PYTHONPATH": os.pathsep.join([str(HERE.parent), *filter(None, sys.path)]),
        },
    )
    return process, [int(p) for p in process.stdout.readline().split()[1:]]


def run(moments, ranks, seed=1):
    """Interrupt runs; return how many were, and after how many steps each.

    The signal goes to one rank, or to all of them at slightly different moments.
    """
    dice = random.Random(seed)
    process, pids = launch(ranks)

    def go(delay=None):
        process.stdin.write("go\n")
        process.stdin.flush()
        assert process.stdout.readline().split() == ["begin"]
        start = time.monotonic()
        if delay is not None:
            time.sleep(delay)
            chosen = dice.choice([pids, *([pid] for pid in pids)]) if ranks > 1 else pids
            for pid in dice.sample(chosen, len(chosen)):
                os.kill(pid, signal.SIGINT)
                time.sleep(dice.uniform(0.0, 0.01))
        word, steps = process.stdout.readline().split()
        return word, int(steps), time.monotonic() - start

    seconds = go()[2]
    after = []
    while len(after) < moments:
        word, steps, _ = go(dice.uniform(0.0, 0.8) * seconds)
        if word == "interrupted":
            after.append(steps)
    process.stdin.close()
    process.wait()
    return after


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Send Ctrl-C to runs.")
    parser.add_argument("--moments", type=int, default=40)
    parser.add_argument("--ranks", type=int, default=1)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--child", action="store_true", help="be what is interrupted")
    args = parser.parse_args()
    if args.child:
        child()
    else:
        after = run(args.moments, args.ranks, args.seed)
        print(f"{len(after)} interruptions on {args.ranks} rank(s), after {sorted(after)} steps")
