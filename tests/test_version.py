# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""One version: what names it elsewhere agrees with the package."""

import json
import re
from pathlib import Path

import pytest

import mpm_dolfinx
from mpm_dolfinx import _core

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


def test_loops_of_other_sources_are_told():
    made_of = getattr(_core.loops, "sources", "")
    assert len(made_of) == 64
    _core.require_of(made_of, made_of)
    _core.require_of("", made_of)  # a wheel has no sources
    with pytest.raises(ImportError, match="install mpm_dolfinx again"):
        _core.require_of("0" * 64, made_of)
