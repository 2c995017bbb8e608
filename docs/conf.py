"""How Sphinx makes the site of `docs/`: ``make docs``, then open `build/docs/index.html`.

Nothing is fetched: theme and search are local files. Warnings are errors there, so a reference that
leads nowhere fails.
"""

from __future__ import annotations

import os
import sys
from fnmatch import fnmatch
from importlib import import_module
from pathlib import Path
from typing import Any

from sphinx.ext.napoleon import Config
from sphinx.ext.napoleon.docstring import NumpyDocstring

# Nothing is computed here: threads of BLAS would only be started.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
sys.path.insert(0, str(ROOT))
from redetect import __version__  # noqa: E402

project = "redetect"
release = version = __version__
copyright = "the authors of redetect, BSD-3-Clause"

extensions = ["myst_parser", "sphinx.ext.autodoc"]

# --- Pages in Markdown ---------------------------------------------------------------------------
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
#: Headings that links may name, as GitHub names them.
myst_heading_anchors = 4

# --- API from docstrings -------------------------------------------------------------------------
#: A page for each of these and of the packages in them.
ROOMS = ("redetect", "camera", "lut", "detect")
#: Compiled kernels are called through what is there; the command line tells of itself (`--help`).
_NO_LIBRARY = (
    *("*kernels.py", "__init__.py", "__main__.py"),
    *("cli.py", "*command.py", "commands.py", "*options.py"),
)
autodoc_default_options = {"members": True, "ignore-module-all": True}
#: Types stand in the docstrings, with their shapes.
autodoc_typehints = "none"
autodoc_use_type_comments = False
#: Optional at run time, and not needed to describe what there is.
autodoc_mock_imports = ["rerun"]
_DOCSTRINGS: Any = Config(
    napoleon_use_param=False,
    napoleon_use_rtype=False,
    napoleon_custom_sections=[("Attributes", "params_style")],
)
#: Single backticks are code, as everywhere in the project.
default_role = "code"

# --- References ----------------------------------------------------------------------------------
nitpicky = True
#: A parameter of that name is what is raised.
nitpick_ignore = [("py:exc", "error")]

# --- Looks ---------------------------------------------------------------------------------------
html_theme = "furo"
html_title = f"{project} {release}"
html_show_sphinx = False
html_copy_source = False


def write_api_pages(app: Any) -> None:
    """Write a page for each package, with its modules one below the other."""
    folder = Path(app.srcdir) / "api"
    folder.mkdir(exist_ok=True)
    pages = {}
    for package in _packages():
        name = _name(package)
        text = _heading(name, "=") + f".. automodule:: {name}\n   :no-members:\n\n"
        for module in sorted(package.glob("*.py")):
            if not any(fnmatch(module.name, pattern) for pattern in _NO_LIBRARY):
                full_name = f"{name}.{module.stem}"
                text += _heading(full_name, "-") + f".. automodule:: {full_name}\n\n"
        pages[folder / f"{name}.rst"] = text
    for stale in set(folder.glob("*.rst")) - set(pages):
        stale.unlink()
    for page, text in pages.items():
        # What has not changed keeps its time, and is not read again.
        if not page.is_file() or page.read_text("utf-8") != text:
            page.write_text(text, "utf-8")


def skip_constants(
    _app: Any, what: str, _name: str, member: object, _skip: bool, _options: Any
) -> bool | None:
    """Leave the constants of modules out: what they mean stands where they are used."""
    return True if what == "module" and not callable(member) else None


def expand_sections(
    app: Any, what: Any, name: str, member: object, options: Any, lines: list[str]
) -> None:
    """Turn the sections of numpydoc into what Sphinx knows; a property's docstring has none."""
    if what not in ("property", "attribute", "data"):
        lines[:] = NumpyDocstring(lines, _DOCSTRINGS, app, what, name, member, options).lines()


def resolve_where_defined(app: Any, env: Any, node: Any, content: Any) -> Any:
    """Follow a name that a package passes on, `camera.CameraError`, to where it is defined.

    Names of other projects stay text: there is nothing here that they could lead to.
    """
    package, _, name = node.get("reftarget", "").rpartition(".")
    if node.get("refdomain") != "py" or package not in map(_name, _packages()):
        return content if package.split(".")[0] in ("numpy", "collections", "concurrent") else None
    member = getattr(import_module(package), name, None)
    target = f"{getattr(member, '__module__', package)}.{name}"
    domain = env.get_domain("py")
    builder, document = app.builder, node["refdoc"]
    return domain.resolve_xref(env, document, builder, node["reftype"], target, node, content)


def _packages() -> list[Path]:
    found = [file.parent for room in ROOMS for file in sorted((ROOT / room).rglob("__init__.py"))]
    return [package for package in found if package.name != "commands"]


def _name(package: Path) -> str:
    return ".".join(package.relative_to(ROOT).parts)


def _heading(text: str, line: str) -> str:
    return f"{text}\n{line * len(text)}\n\n"


def setup(app: Any) -> None:
    """Tell Sphinx of the functions above."""
    app.connect("builder-inited", write_api_pages)
    app.connect("autodoc-skip-member", skip_constants)
    app.connect("autodoc-process-docstring", expand_sections)
    app.connect("missing-reference", resolve_where_defined)
