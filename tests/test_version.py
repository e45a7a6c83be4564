# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""One version: what names it elsewhere agrees with the package."""

import json
import re
from pathlib import Path

import mpm_dolfinx

ROOT = Path(__file__).parents[1]


def test_citation_names_the_version():
    text = (ROOT / "CITATION.cff").read_text("utf-8")
    assert re.findall(r"^version: (.*)$", text, re.MULTILINE) == [mpm_dolfinx.__version__]
    metadata = json.loads((ROOT / "codemeta.json").read_text("utf-8"))
    assert metadata["version"] == mpm_dolfinx.__version__


def test_changelog_begins_with_the_version_or_what_is_not_released():
    headings = re.findall(
        r"^## \[(.*?)\]", (ROOT / "CHANGELOG.md").read_text("utf-8"), re.MULTILINE
    )
    assert headings[0].startswith("Unreleased") or headings[0] == mpm_dolfinx.__version__
    assert mpm_dolfinx.__version__ in headings
