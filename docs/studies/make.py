# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Make the tables of the documentation again, and say which no longer follow.

    python docs/studies/make.py NAME ...      run these tables, write them into their pages
    python docs/studies/make.py               all but those of run times
    python docs/studies/make.py --stale ...   of these only the rows that no longer follow
    python docs/studies/make.py --check       what does not follow: runs the quick rows
    python docs/studies/make.py --still       the same without any run
    python docs/studies/make.py --stamp TABLE scripts have changed in what does not matter to it

NAME is a table, as ``locking/cantilever``, or the beginning of several, as ``locking``. A comment
above each table of measured numbers tells where it comes from:

    <!-- table locking/cantilever: 01ab 23cd 45ef 6789abcd -->  made by this program
    <!-- table by benchmarks/skip.py: 0123abcd 4567ef89 -->     by another one, copied by hand
    <!-- table once: abcdef0, REASON -->                        not made again; of this commit

The last number is a hash of the table's rows, those before it are of what it is made of: the code
of the scripts, or for each row that of its function, of what that uses, and of the cases that it
runs (``ingredients.py``). A table does not follow where these have changed since, where it was
edited by hand, or where its quick rows come out otherwise. ``--stamp`` writes the numbers of one
table anew, for one copied by hand from what another program has printed: TABLE is its name, or its
page and line, as complaints tell them, ``docs/locking-measured.md:169``.
"""

from __future__ import annotations

import argparse
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import error
import high_order
import ingredients
import load_steps
import locking
import methods
import soils
import solver
import splitting
import step_size
import supports
import validation
from case_runs import ROOT, Table, head, row
from ingredients import digest

DOCS = ROOT / "docs"
SCRIPTS = (
    error,
    step_size,
    load_steps,
    locking,
    splitting,
    soils,
    methods,
    high_order,
    solver,
    supports,
    validation,
)
TABLES: dict[str, tuple[Table, Path]] = {
    name: (table, Path(str(script.__file__)))
    for script in SCRIPTS
    for name, table in script.tables().items()
}
MARK = re.compile(r"<!-- table (?P<source>[^:>]*)(?::\s*(?P<rest>[^>]*?))?\s*-->")
NUMBER = re.compile(r"^[*<≤≥+\-−\s$]*\d")


class Found(NamedTuple):
    """A table in a page: its lines from ``start`` to ``stop``, and the comment above it."""

    page: str
    start: int
    stop: int
    rows: list[str]
    mark: re.Match[str] | None
    at: int

    @property
    def source(self) -> str:
        return self.mark["source"] if self.mark else ""

    @property
    def name(self) -> str:
        """What a complaint calls it."""
        return f"docs/{self.page}.md:{self.start + 1}"


def scripts_of(source: str) -> list[Path]:
    """Return the scripts that a table comes from."""
    if source.startswith("by "):
        words = [ROOT / word for word in shlex.split(source[3:])]
        return [path for path in words if path.suffix == ".py"]
    table, script = TABLES[source]
    return [script, *(ROOT / f"benchmarks/cases/{case}.py" for case in table.cases)]


def inputs(source: str) -> list[str]:
    """Return a hash of what each row of a table is made of, or one of its scripts."""
    if source in TABLES:
        table, _ = TABLES[source]
        return [ingredients.of_row(table, label) for label in table.rows]
    return [digest("\n".join(map(ingredients.plain, scripts_of(source))))]


def rows_hash(rows: list[str]) -> str:
    return digest("\n".join(rows))


def kept(found: Found) -> tuple[list[str], str]:
    """Return the hashes that a table was marked with: of what it is made of, and of its rows."""
    *made_of, rows = (found.mark["rest"] or "").split() if found.mark else ()
    return made_of, rows


def late(found: Found) -> list[str]:
    """Return the labels of the rows of a table that have to be made again."""
    table, _ = TABLES[found.source]
    new, old = inputs(found.source), kept(found)[0]
    if found.rows[:2] != head(table) or len(new) != len(old) or len(found.rows) != len(new) + 2:
        return list(table.rows)
    begins = [
        text.startswith(f"| {label} |")
        for text, label in zip(found.rows[2:], table.rows, strict=True)
    ]
    return [
        label
        for label, a, b, here in zip(table.rows, new, old, begins, strict=True)
        if a != b or not here
    ]


def found_in(page: str) -> Iterator[Found]:
    """Yield the tables of a page."""
    lines = (DOCS / f"{page}.md").read_text("utf-8").splitlines()
    start, fenced = None, False
    for i, text in enumerate([*lines, ""]):
        fenced ^= text.startswith("```")
        if text.startswith("|") and not fenced:
            start = i if start is None else start
        elif start is not None:
            at = start - 1
            while at >= 0 and not lines[at].strip():
                at -= 1
            yield Found(page, start, i, lines[start:i], MARK.fullmatch(lines[at].strip()), at)
            start = None


def measured(rows: list[str]) -> bool:
    """Return whether a table holds measured numbers: a quarter of its cells begin with a digit."""
    cells = [c.strip() for text in rows[2:] for c in text.strip().strip("|").split("|")[1:]]
    filled = [c for c in cells if c]
    numbers = [c for c in filled if NUMBER.match(c) and "\\sin" not in c]
    return len(numbers) >= max(1.0, 0.25 * len(filled))


def all_found() -> list[Found]:
    return [f for path in sorted(DOCS.glob("*.md")) for f in found_in(path.stem)]


def marked(source: str, rows: list[str]) -> str:
    return f"<!-- table {source}: {' '.join([*inputs(source), rows_hash(rows)])} -->"


def put(found: Found, rows: list[str]) -> None:
    """Write rows and their comment in place of a table."""
    path = DOCS / f"{found.page}.md"
    lines = path.read_text("utf-8").splitlines()
    lines[found.start : found.stop] = rows
    lines[found.at] = marked(found.source, rows)
    path.write_text("\n".join(lines) + "\n", "utf-8")


def stamp(name: str) -> None:
    """Write the hashes of the one table that has this name, or stands at this line of a page."""
    every = [f for f in all_found() if f.source not in ("", "once")]
    chosen = [f for f in every if name in (f.name, f.source)]
    if len(chosen) != 1:
        page = name.partition(":")[0].removeprefix("docs/").removesuffix(".md")
        there = [f for f in chosen or every if chosen or f.page == page]
        places = "".join(f"\n  {f.name}  {f.source}" for f in there)
        raise SystemExit(f"{name!r} names {len(chosen)} tables where one is stamped.{places}")
    put(chosen[0], chosen[0].rows)


def make(name: str, stale: bool = False) -> bool:
    """Run a table, or its stale rows, and write them. Return whether that changed the page."""
    table, _ = TABLES[name]
    here = next(f for f in found_in(table.page) if f.source == name)
    chosen = late(here) if stale else list(table.rows)
    rows = head(table)
    for place, label in enumerate(table.rows, 2):
        rows.append(row(table, label) if label in chosen else here.rows[place])
        if label in chosen:
            print(rows[-1], flush=True)
    if chosen:
        put(next(f for f in found_in(table.page) if f.source == name), rows)
    return rows != here.rows


def complaints(found: Found, still: bool) -> list[str]:
    """Return what does not follow of a table."""
    if found.mark is None:
        return ["no comment says where its numbers come from"] if measured(found.rows) else []
    source = found.source
    if source == "once":
        return [] if found.mark["rest"] else ["no reason is given"]
    if not source.startswith("by ") and source not in TABLES:
        return [f"there is no table {source!r}"]
    missing = [str(p.relative_to(ROOT)) for p in scripts_of(source) if not p.exists()]
    if missing or not scripts_of(source):
        return [f"{source!r} names no script that exists"]
    if not found.mark["rest"]:
        return ["it has not been made yet"]
    made_of, rows = kept(found)
    new = []
    if source in TABLES:
        labels = late(found)
        changed = [f"{len(labels)} of {len(TABLES[source][0].rows)} rows"] if labels else []
    else:
        changed = ["the scripts"] if made_of != inputs(source) else []
    new += [f"{what} of {source!r} have changed since it was made" for what in changed]
    if rows != rows_hash(found.rows):
        copied = f"the rows of {source!r} have changed since it was made"
        new.append("its rows were changed by hand" if source in TABLES else copied)
    if source in TABLES and not still and not TABLES[source][0].times:
        table, _ = TABLES[source]
        anew = [row(table, label) for label in table.quick]
        new += [f"{source} is now {text}" for text in anew if text not in found.rows]
    return new


def check(still: bool, chosen: list[str]) -> int:
    """Print what does not follow, and return how many complaints there are."""
    total = 0
    every = all_found()
    for found in every:
        if chosen and not found.source.startswith(tuple(chosen)):
            continue
        new = complaints(found, still)
        total += len(new)
        for text in new:
            print(f"{found.name}: {text}", flush=True)
    for name in TABLES.keys() - {found.source for found in every}:
        total += 1
        print(f"{name} stands in no page", flush=True)
    print(f"{len(every)} tables, {total} complaints")
    return total


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="a table, or its beginning")
    parser.add_argument("--check", action="store_true", help="change nothing, run the quick rows")
    parser.add_argument("--still", action="store_true", help="change nothing, run nothing")
    parser.add_argument("--stale", action="store_true", help="make only rows that do not follow")
    parser.add_argument("--stamp", metavar="TABLE", help="write the hashes of one table")
    parser.add_argument("--times", action="store_true", help="also tables of run times")
    args = parser.parse_args()
    if args.stamp:
        stamp(args.stamp)
        return
    unknown = [n for n in args.names if not any(t.startswith(n) for t in TABLES)]
    if unknown:
        parser.error(f"no such table: {', '.join(unknown)}; there are {', '.join(TABLES)}")
    if args.check or args.still:
        raise SystemExit(1 if check(args.still, args.names) else 0)
    places = {found.source for found in all_found()}
    homeless = [name for name in TABLES if name not in places]
    if homeless:
        raise SystemExit(f"No page has a comment <!-- table {homeless[0]}: --> above a table.")
    changed = []
    for name, (table, _) in TABLES.items():
        named = any(name.startswith(n) for n in args.names)
        if named or not (args.names or (table.times and not args.times)):
            print(f"\n{name}", flush=True)
            changed += [name] if make(name, args.stale) else []
    for name in changed:
        print(f"{name} has changed: read what docs/{TABLES[name][0].page}.md says about it")


if __name__ == "__main__":
    main()
