"""Relative links and pictures of all documents lead to files of the project."""

from __future__ import annotations

import re
from pathlib import Path

from tests.docs.blocks import documents

_LINK = re.compile(r"\]\(\s*([^)\s]+)\s*\)")


def lost_links(document: Path) -> list[str]:
    lost = []
    text = re.sub(r"^```.*?^```$", "", document.read_text("utf-8"), flags=re.M | re.S)
    for target in _LINK.findall(text):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        place = document.parent / path if path else document
        if not place.exists() or (anchor and anchor not in anchors_of(place)):
            lost.append(f"{document.name}: {target}")
    return lost


def anchors_of(document: Path) -> set[str]:
    """How the headings of a document are called in links."""
    headings = re.findall(r"^#+ (.+)$", document.read_text("utf-8"), flags=re.M)
    kept = [re.sub(r"[^\w\- ]", "", heading.lower()) for heading in headings]
    return {heading.replace(" ", "-") for heading in kept}


def test_links_lead_to_files(project_root: Path) -> None:
    found = documents(project_root)
    assert len(found) > 15
    assert [lost for document in found for lost in lost_links(document)] == []


def test_a_link_that_leads_nowhere_is_noticed(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("# A heading\n[a](page.md) [b](other.md) [c](#a-heading) [d](page.md#none)\n")
    assert lost_links(page) == ["page.md: other.md", "page.md: page.md#none"]
