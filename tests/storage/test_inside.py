"""Names within a folder: those that are told at one look, and all others."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from redetect.storage.bounded import leads_out

NAMES = st.text(st.sampled_from("conprauxlt019.-_e \\/:"), max_size=9)


@given(name=NAMES)
def test_plain_names_are_judged_as_all_others(name: str) -> None:
    """In a folder that is named as well, no name is plain."""
    in_folder = leads_out(f"folder/{name}", "/any/home")
    alone = leads_out(name, "/any/home")
    if alone is None:
        assert in_folder is None
    else:
        assert in_folder == alone or ".." in name or alone == "is an absolute path"


@pytest.mark.parametrize("name", ["e.0000", "aux.jpg", "con", "a..b", "a/../b"])
def test_names_that_stay(name: str) -> None:
    assert leads_out(name) is None
