# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Run demos and keep what they print and draw for their pages and their test.

usage: run_demos.py [NAME ...]    all of them, or demos/demo_NAME.py

Each runs in a directory of its own, on one rank. Its picture NAME.png (and NAME.gif, where it makes
a movie) and its output NAME.txt go to docs/images/demos.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DEMOS, KEPT = ROOT / "demos", ROOT / "docs" / "images" / "demos"


def run(name: str) -> None:
    """Run a demo and keep what it leaves."""
    with tempfile.TemporaryDirectory() as folder:
        begin = time.perf_counter()
        done = subprocess.run(
            [sys.executable, str(DEMOS / f"demo_{name}.py")],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "agg"},
            stdout=subprocess.PIPE,
            text=True,
        )
        if done.returncode != 0:
            sys.exit(f"demo_{name}.py failed.")
        picture = Path(folder) / f"{name}.png"
        if not picture.exists():
            sys.exit(f"demo_{name}.py must leave a picture {name}.png in the working directory.")
        KEPT.mkdir(parents=True, exist_ok=True)
        for kind in ("png", "gif"):
            made = Path(folder) / f"{name}.{kind}"
            if made.exists():
                shutil.copyfile(made, KEPT / made.name)
        (KEPT / f"{name}.txt").write_text(done.stdout, "utf-8")
        print(f"{name}: {time.perf_counter() - begin:.1f} s", flush=True)


if __name__ == "__main__":
    every = sorted(path.stem.removeprefix("demo_") for path in DEMOS.glob("demo_*.py"))
    for chosen in sys.argv[1:] or every:
        run(chosen)
