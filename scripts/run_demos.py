# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Run demos and keep what they print and draw for their pages and their test.

usage: run_demos.py [--models] [NAME ...]    all of them, or demos/demo_NAME.py

Each runs in a directory of its own, on one rank. Its picture NAME.png (and NAME.gif, where it makes
a movie), one panel of that for the gallery, NAME_card.png, a sketch NAME_model.png of the first
problem that it runs, and its output NAME.txt go to docs/images/demos.
With --models it ends with the sketch, which alone is kept.
"""

from __future__ import annotations

import os
import runpy
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
DEMOS, KEPT = ROOT / "demos", ROOT / "docs" / "images" / "demos"


class Drawn(BaseException):
    """The model is drawn, and nothing else was asked for."""


def keep_card(name: str) -> None:
    """Let the figure that is saved as NAME.png leave the panel with the largest body besides."""
    from matplotlib.figure import Figure

    save = Figure.savefig

    def weight(axes):
        bars = axes.get_label() == "<colorbar>"
        box = axes.get_position()
        return not bars, bool(axes.images or axes.collections), round(box.width * box.height, 3)

    def both(figure, target, *args, **options):
        save(figure, target, *args, **options)
        if Path(str(target)).name == f"{name}.png":
            figure.canvas.draw()
            *_, chosen = sorted(figure.axes, key=weight)
            panel = chosen.get_window_extent().transformed(figure.dpi_scale_trans.inverted())
            legend = chosen.get_legend()
            if legend is not None:  # too small to be read there
                legend.set_visible(False)
            save(figure, f"{name}_card.png", bbox_inches=panel, dpi=200)

    Figure.savefig = both


def follow(script: str, picture: str, model: bool) -> None:
    """Run a script, and draw the first problem that it runs before that does."""
    import mpm_dolfinx as mpm

    keep_card(picture.removesuffix("_model.png"))

    kinds = [mpm.Problem]
    for kind in kinds:
        kinds += [k for k in kind.__subclasses__() if k not in kinds]
    running = ("solve", "steps", "step")
    own = [
        (kind, name, vars(kind)[name]) for kind in kinds for name in running if name in vars(kind)
    ]

    def first_of(method):
        def first(problem, *args, **options):
            for known in own:
                setattr(*known)
            mpm.plot.sketch(problem, picture)
            if model:
                raise Drawn
            return method(problem, *args, **options)

        return first

    for kind, name, method in own:
        setattr(kind, name, first_of(method))
    try:
        runpy.run_path(script, run_name="__main__")
    except Drawn:
        pass


def run(name: str, model: bool) -> None:
    """Run a demo and keep what it leaves."""
    with tempfile.TemporaryDirectory() as folder:
        begin = time.perf_counter()
        parts = ("--follow", str(DEMOS / f"demo_{name}.py"), f"{name}_model.png", str(int(model)))
        done = subprocess.run(
            [sys.executable, __file__, *parts],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "agg"},
            stdout=subprocess.PIPE,
            text=True,
        )
        if done.returncode != 0:
            sys.exit(f"demo_{name}.py failed.")
        wanted = [f"{name}_model.png", *([] if model else [f"{name}.png"])]
        for picture in wanted:
            if not (Path(folder) / picture).exists():
                sys.exit(f"demo_{name}.py must run a problem and leave a picture {picture}.")
        KEPT.mkdir(parents=True, exist_ok=True)
        small = (f"{name}_model.png", f"{name}_card.png")
        for made in (*small, f"{name}.png", f"{name}.gif"):
            if (Path(folder) / made).exists():
                shutil.copyfile(Path(folder) / made, KEPT / made)
        for made in (KEPT / each for each in small if (Path(folder) / each).exists()):
            image = Image.open(made).convert("RGB")
            if made.name.endswith("_card.png"):
                image.thumbnail((480, 300))
            image.quantize(256).save(made, optimize=True)
        if not model:
            (KEPT / f"{name}.txt").write_text(done.stdout, "utf-8")
        print(f"{name}: {time.perf_counter() - begin:.1f} s", flush=True)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--follow"]:
        follow(sys.argv[2], sys.argv[3], bool(int(sys.argv[4])))
        sys.exit()
    given = [name for name in sys.argv[1:] if name != "--models"]
    every = sorted(path.stem.removeprefix("demo_") for path in DEMOS.glob("demo_*.py"))
    for chosen in given or every:
        run(chosen, "--models" in sys.argv)
