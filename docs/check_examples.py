# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Run the Python examples of README and documentation, each page from top to bottom.

python docs/check_examples.py [PAGE...]
"""

from __future__ import annotations

import os
import re
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
EXAMPLE = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)


def main() -> None:
    pages = [Path(page).resolve() for page in sys.argv[1:]]
    pages = pages or [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        for page in pages:
            names = {"__name__": "__main__"}
            for example in EXAMPLE.finditer(page.read_text("utf-8")):
                line = page.read_text("utf-8")[: example.start()].count("\n") + 1
                code = compile("\n" * line + example[1], str(page), "exec")
                exec(code, names)
            print(f"{page.name}: done", flush=True)


if __name__ == "__main__":
    main()
