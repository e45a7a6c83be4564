# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Pages that tell how to do something are short; what was measured stands beside them."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
MOST_BYTES = 9000
MOST_LINES = 60

pytestmark = pytest.mark.skip_in_parallel


def guide():
    """Return the pages that tell how to do it, which the navigation lists before the background."""
    nav = (ROOT / "mkdocs.yml").read_text("utf-8").partition("\nnav:\n")[2]
    return re.findall(r": (\S+\.md)$", nav.partition("  - Background:\n")[0], re.MULTILINE)


def test_pages_of_the_guide_are_short():
    pages = guide()
    assert len(pages) > 20
    sizes = {page: len((ROOT / "docs" / page).read_bytes()) for page in pages}
    assert not {page: size for page, size in sizes.items() if size > MOST_BYTES}


def test_each_release_of_the_changelog_is_short():
    text = (ROOT / "CHANGELOG.md").read_text("utf-8")
    name, *releases = re.split(r"^(?=## )", text, flags=re.MULTILINE)
    assert name.startswith("# Changelog") and len(releases) > 2
    lines = {r.partition("\n")[0]: len(re.findall(r"^.", r, re.MULTILINE)) for r in releases}
    assert not {release: count for release, count in lines.items() if count > MOST_LINES}
