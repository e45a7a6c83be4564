# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Runs all scenes in worker processes and reports: ``make stress``.

usage: python -m stress.run [--seed N] [--jobs N] [--only CLASS|NUMBER ...] [--report FILE]
                            [--plot FILE]

A scene has a limit of processor seconds; a worker that passes it, or dies, is replaced, and the
scene counts as hung or crashed. The run fails (status 1) where a scene crashes, hangs or is
silently wrong, where a well-posed class completes to less than 98 %, or where other scenes stop
than ``stops.json`` lists (``--accept`` writes that list anew). With another seed there is no list:
then a class that is not well posed must complete to as large a share as with the usual one, less
what chance may take from it.
"""

from __future__ import annotations

import argparse
import json
import os
import queue
import subprocess
import sys
import threading
import time
from collections import Counter
from pathlib import Path

from stress import generator

HERE = Path(__file__).parent
OUTCOMES = ("completed", "stopped", "crashed", "hung", "silent")
LEAST = 0.98
#: Wall-clock seconds allowed for each processor second, since others may use the machine.
PATIENCE = 8.0
TICK = os.sysconf("SC_CLK_TCK")


class Worker:
    """A process that runs one scene at a time."""

    def __init__(self, log):
        self.log = log
        self.start()

    def start(self):
        self.process = subprocess.Popen(
            [sys.executable, "-m", "stress.worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self.log,
            text=True,
            bufsize=1,
        )
        self.lines = queue.Queue()
        threading.Thread(target=self._read, args=(self.process, self.lines), daemon=True).start()

    @staticmethod
    def _read(process, lines):
        for line in process.stdout:
            lines.put(line)
        lines.put(None)

    def seconds(self):
        """Return the processor seconds that the process has used."""
        try:
            fields = Path(f"/proc/{self.process.pid}/stat").read_text().rsplit(")", 1)[1].split()
        except OSError:
            return 0.0
        return (int(fields[11]) + int(fields[12])) / TICK

    def run(self, scene):
        """Return what became of a scene."""
        if self.process.poll() is not None:
            self.start()
        started, used = time.monotonic(), self.seconds()
        limit = scene["limit"]
        self.process.stdin.write(f"{scene['number']} {scene['seed']}\n")
        self.process.stdin.flush()
        while True:
            try:
                line = self.lines.get(timeout=0.2)
            except queue.Empty:
                wall = time.monotonic() - started
                if self.seconds() - used > limit or wall > PATIENCE * limit:
                    self.stop()
                    return self.lost(scene, "hung", f"more than {limit:.0f} s", limit)
                continue
            if line is None:
                status = self.process.wait()
                return self.lost(scene, "crashed", f"the process ended with status {status}", 0.0)
            return json.loads(line)

    @staticmethod
    def lost(scene, outcome, reason, seconds):
        return {
            "number": scene["number"],
            "class": scene["class"],
            "outcome": outcome,
            "reason": reason,
            "seconds": seconds,
        }

    def stop(self):
        self.process.kill()
        self.process.wait()


def run_all(numbers, jobs, progress, seed=generator.SEED):
    """Return the results of scenes by number."""
    todo: queue.Queue[int] = queue.Queue()
    for number in numbers:
        todo.put(number)
    results = {}
    log = open(os.devnull, "w") if progress else None

    def serve():
        worker = Worker(log)
        try:
            while True:
                try:
                    number = todo.get_nowait()
                except queue.Empty:
                    return
                result = worker.run(generator.scene(number, seed))
                results[number] = result
                if progress:
                    line = f"{len(results)}/{len(numbers)} {number} {result['class']}: "
                    line += f"{result['outcome']} {result['reason'][:160]}"
                    print(line, file=sys.stderr, flush=True)
        finally:
            worker.stop()

    threads = [threading.Thread(target=serve) for _ in range(jobs)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return dict(sorted(results.items()))


def counts(results):
    """Return the number of scenes of each outcome."""
    found = Counter(r["outcome"] for r in results)
    return {"scenes": len(results), **{name: found[name] for name in OUTCOMES}}


def summary(results):
    """Return the report: counts of all scenes and of each class, and the scenes that failed."""
    classes = {}
    for name, (_, _, well_posed) in generator.CLASSES.items():
        mine = [r for r in results.values() if r["class"] == name]
        if mine:
            share = sum(r["outcome"] == "completed" for r in mine) / len(mine)
            seconds = round(sum(r["seconds"] for r in mine), 1)
            classes[name] = {
                **counts(mine),
                "well_posed": well_posed,
                "share": round(share, 4),
                "seconds": seconds,
            }
    failed = {
        str(n): {"class": r["class"], "outcome": r["outcome"], "reason": r["reason"]}
        for n, r in results.items()
        if r["outcome"] != "completed"
    }
    return {**counts(list(results.values())), "classes": classes, "not_completed": failed}


def table(report):
    """Return the report as a table."""
    head = ("class", "scenes", *OUTCOMES, "share", "CPU s")
    rows = [
        (
            name + (" *" if c["well_posed"] else ""),
            *(str(c[k]) for k in ("scenes", *OUTCOMES)),
            f"{c['share']:.1%}",
            f"{c['seconds']:.0f}",
        )
        for name, c in report["classes"].items()
    ]
    total = sum(c["seconds"] for c in report["classes"].values())
    share = report["completed"] / max(1, report["scenes"])
    rows.append(
        (
            "all",
            *(str(report[k]) for k in ("scenes", *OUTCOMES)),
            f"{share:.1%}",
            f"{total:.0f}",
        )
    )
    widths = [max(len(row[i]) for row in (head, *rows)) for i in range(len(head))]
    lines = [
        "  ".join(
            cell.ljust(w) if i == 0 else cell.rjust(w)
            for i, (cell, w) in enumerate(zip(row, widths, strict=True))
        )
        for row in (head, *rows)
    ]
    lines.append(f"* physically well posed: at least {LEAST:.0%} must complete")
    return "\n".join(lines)


def plot(report, path):
    """Draw what became of each class's scenes, and why those that stopped did."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    colours = dict(
        zip(OUTCOMES, ("#4c9f70", "#e0b13c", "#b3262a", "#6a3d9a", "#1f1f1f"), strict=True)
    )
    names = list(report["classes"])
    reasons = Counter(
        f["reason"].split(":")[0] if f["outcome"] == "stopped" else f["outcome"]
        for f in report["not_completed"].values()
    )
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(11, 0.3 * len(names) + 1.8), width_ratios=(3, 1), layout="constrained"
    )
    start = [0] * len(names)
    for outcome in OUTCOMES:
        values = [report["classes"][n][outcome] for n in names]
        left.barh(names, values, left=start, color=colours[outcome], label=outcome)
        start = [a + b for a, b in zip(start, values, strict=True)]
    for i, name in enumerate(names):
        data = report["classes"][name]
        left.text(start[i] + 0.5, i, f"{data['share']:.0%}", va="center", fontsize=8)
    left.invert_yaxis()
    left.set_yticks(
        range(len(names)), [n + (" *" if report["classes"][n]["well_posed"] else "") for n in names]
    )
    left.set_xlabel("scenes (* well posed)")
    left.legend(loc="lower right", frameon=False)
    left.spines[["top", "right"]].set_visible(False)
    labels = [k for k, _ in reasons.most_common()]
    right.barh(labels, [reasons[k] for k in labels], color="#8a8a8a")
    right.invert_yaxis()
    right.set_title("why scenes stopped", fontsize=10)
    right.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=130)


def most_stops(name, count, listed):
    """Return how many of so many scenes of a class may stop, if as likely as those listed.

    Three standard deviations above what is to be expected, and one more.
    """
    place = 1 + list(generator.CLASSES).index(name)
    likely = sum(int(n) // 1000 == place for n in listed) / generator.CLASSES[name][0]
    return count * likely + 3.0 * (count * likely * (1.0 - likely)) ** 0.5 + 1.0


def complaints(report, listed, seed=generator.SEED):
    """Return what is wrong with a report: stops by the list, those of other seeds by class."""
    failed = report["not_completed"].items()
    found = [
        f"{outcome}: {', '.join(n for n, f in failed if f['outcome'] == outcome)}"
        for outcome in ("crashed", "hung", "silent")
        if report[outcome]
    ]
    found += [
        f"{name} completes to {c['share']:.1%}"
        for name, c in report["classes"].items()
        if c["well_posed"] and c["share"] < LEAST
    ]
    if seed != generator.SEED:
        return found + [
            f"{name} stops in {c['stopped']} of {c['scenes']} scenes"
            for name, c in report["classes"].items()
            if c["stopped"] > most_stops(name, c["scenes"], listed)
        ]
    stopped = {n for n, f in report["not_completed"].items() if f["outcome"] == "stopped"}
    if new := sorted(stopped - set(listed), key=int):
        found.append(f"stopped, and not listed in stops.json: {', '.join(new)}")
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=generator.SEED, help="makes other scenes")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="processes")
    parser.add_argument("--only", nargs="+", default=[], help="classes or numbers of scenes")
    parser.add_argument("--report", type=Path, default=HERE / "report.json")
    parser.add_argument("--plot", type=Path, default=HERE / "report.png")
    parser.add_argument("--accept", action="store_true", help="write stops.json")
    args = parser.parse_args()
    known = generator.numbers()
    numbers = [n for n in known if not args.only or known[n] in args.only or str(n) in args.only]
    if not numbers:
        parser.error(f"no such class or scene; there are {', '.join(generator.CLASSES)}")
    # The long ones first, so that no process is left with one at the end.
    numbers.sort(key=lambda n: -generator.scene(n)["limit"])
    os.environ["PYTHONPATH"] = os.pathsep.join([str(HERE.parent), os.environ.get("PYTHONPATH", "")])
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    results = run_all(numbers, max(1, args.jobs), True, args.seed)
    report = summary(results)
    args.report.write_text(json.dumps(report, indent=1) + "\n")
    plot(report, args.plot)
    print(table(report))
    stops = HERE / "stops.json"
    if args.accept and args.seed != generator.SEED:
        parser.error("stops.json is of the usual seed")
    if args.accept:
        listed = {} if not args.only or not stops.exists() else json.loads(stops.read_text())
        listed = {n: r for n, r in listed.items() if int(n) not in results}
        listed |= {
            n: f["reason"] for n, f in report["not_completed"].items() if f["outcome"] == "stopped"
        }
        listed = dict(sorted(listed.items(), key=lambda item: int(item[0])))
        stops.write_text(json.dumps(listed, indent=1) + "\n")
    listed = json.loads(stops.read_text()) if stops.exists() else {}
    found = complaints(report, listed, args.seed)
    for complaint in found:
        print(complaint)
    print(f"The report is {args.report}, its picture {args.plot}")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
