"""Relative links and pictures of all documents lead to files of the project."""

from __future__ import annotations

import re
from pathlib import Path

from tests.docs.blocks import documents

_LINK = re.compile(r"\]\(\s*([^)\s]+)\s*\)")
#: Of code and documents; a run's own files need not exist.
_PATH = re.compile(r"(?<![^\s])(?:[\w.-]+/)+(?:[\w.-]+\.(?:py|md|toml))?(?=$|[\s:])")


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


def lost_paths(document: Path, root: Path) -> list[str]:
    """Files and folders of the project, in backticks, that do not exist."""
    text = re.sub(r"^```.*?^```$", "", document.read_text("utf-8"), flags=re.M | re.S)
    named = [path for words in re.findall(r"`([^`\n]+)`", text) for path in _PATH.findall(words)]
    return [
        f"{document.name}: {path}"
        for path in named
        if (root / path.partition("/")[0]).is_dir()
        and not any((above / path).exists() for above in (root, document.parent))
    ]


def anchors_of(document: Path) -> set[str]:
    """How the headings of a document are called in links."""
    headings = re.findall(r"^#+ (.+)$", document.read_text("utf-8"), flags=re.M)
    kept = [re.sub(r"[^\w\- ]", "", heading.lower()) for heading in headings]
    return {heading.replace(" ", "-") for heading in kept}


def test_links_lead_to_files(project_root: Path) -> None:
    found = documents(project_root)
    assert len(found) > 15
    assert [lost for document in found for lost in lost_links(document)] == []


def test_paths_in_backticks_are_files_of_the_project(project_root: Path) -> None:
    found = [*documents(project_root), project_root / "tools" / "simulator" / "README.md"]
    assert [lost for document in found for lost in lost_paths(document, project_root)] == []


def test_a_path_that_leads_nowhere_is_noticed(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    (tmp_path / "tests").mkdir()
    page.write_text("`pytest tests/test_gone.py`, `tests/`, `tests/gone/`, `drive/a.py`\n")
    assert lost_paths(page, tmp_path) == ["page.md: tests/test_gone.py", "page.md: tests/gone/"]


def test_a_link_that_leads_nowhere_is_noticed(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("# A heading\n[a](page.md) [b](other.md) [c](#a-heading) [d](page.md#none)\n")
    assert lost_links(page) == ["page.md: other.md", "page.md: page.md#none"]
