# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Make the paper's PDF, and fail where a reference leads nowhere: make_paper.py [FILE].

Pandoc resolves the references and writes Typst, which sets the pages; both come as wheels.
"""

import re
import sys
from pathlib import Path

import pypandoc
import typst

ROOT = Path(__file__).resolve().parents[1]
PAPER = ROOT / "paper"


def numbered(text: str) -> str:
    """Return the text with the numbers of figures in place of their labels."""
    labels = re.findall(r"\\label\{([\w:]+)\}", text)
    text = re.sub(r"\\label\{[\w:]+\}", "", text)
    return re.sub(
        r"\\autoref\{([\w:]+)\}", lambda found: f"Figure {labels.index(found[1]) + 1}", text
    )


def main() -> None:
    """Write the PDF."""
    pdf = Path(sys.argv[1] if len(sys.argv) > 1 else ROOT / "output" / "paper.pdf").resolve()
    pdf.parent.mkdir(parents=True, exist_ok=True)
    options = ["--standalone", "--citeproc", "--fail-if-warnings", f"--resource-path={PAPER}"]
    options += [f"--bibliography={PAPER / 'paper.bib'}", "--metadata=link-citations"]
    options += ["--variable=papersize:a4", "--variable=fontsize:10.5pt"]
    source = numbered((PAPER / "paper.md").read_text("utf-8"))
    authors = source.partition("\nauthors:\n")[2].partition("\naffiliations:")[0]
    options += [f"--metadata=author:{name}" for name in re.findall(r"- name: (.+)", authors)]
    text = pypandoc.convert_text(source, "typst", "markdown", extra_args=options)
    text = text.replace('image("../', 'image("/')
    typst.compile(text.encode(), output=pdf, root=ROOT)
    print(f"The paper is {pdf}")


if __name__ == "__main__":
    main()
