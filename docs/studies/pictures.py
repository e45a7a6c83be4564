# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Let cases make the pictures of README and documentation: python docs/studies/pictures.py"""

from __future__ import annotations

from pathlib import Path

from case_runs import run
from PIL import Image

IMAGES = Path(__file__).resolve().parents[1] / "images"
WIDTH = 1500  # pixels
PICTURES = {
    "column_roller": ("column_roller",),
    "column_free": ("column_free", "--g0", "all"),
    "column_stop": ("column_free", "--domain", "quad", "--g0", 80e3, "--plain-solver"),
    "snap_through": ("snap_through",),
    "nails": ("structures", "--case", "cut"),
    "column_whole": ("column_free", "--domain", "quad", "--g0", 80e3),
    "column_split": (
        *("column_free", "--domain", "quad", "--particles-per-cell", 1),
        *("--on-distortion", "split"),
    ),
}


def main() -> None:
    for name, (demo, *options) in PICTURES.items():
        path = IMAGES / f"{name}.png"
        run(demo, *options, "--plot", path)
        with Image.open(path) as picture:
            small = picture.convert("RGB")
        small.thumbnail((WIDTH, WIDTH), Image.Resampling.LANCZOS)
        small.save(path, optimize=True)
        print(f"{path}: {path.stat().st_size / 1e3:.0f} kB", flush=True)


if __name__ == "__main__":
    main()
