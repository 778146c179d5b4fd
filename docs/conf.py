"""Configuration of the documentation site: `make docs` writes it to out/site.

The source folder of Sphinx is the repository, so that a link of a page means the same on the site
as in the repository, also a link to ARCHITECTURE.md or to a file of `core`.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from docutils import nodes
from sphinx.application import Sphinx

sys.path.insert(0, str(Path(__file__).parent / "sphinx"))

import haselab

project = "haselab"
author = "the haselab authors"
copyright = author
version = release = haselab.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.viewcode",
    "api_pages",
    "command_pages",
    "mathml",
    "notebook_lexer",
]
root_doc = "docs/index"
include_patterns = [
    "docs/**.md", "docs/**.rst", "docs/**.ipynb",
    "README.md", "CONTRIBUTING.md", "CODE_OF_CONDUCT.md", "SECURITY.md", "ARCHITECTURE.md",
    "CHANGELOG.md",
    "benchmarks/README.md", "examples/plugins/*/README.md",
]  # fmt: skip
exclude_patterns = [
    ".*", "out", "build", "dist", "src", "tests", "**/.ipynb_checkpoints", "docs/sphinx",
]  # fmt: skip
highlight_language = "text"  # not "none", with which the pages of the source have no colours
nitpicky = True
html_math_renderer = "mathml"

# ---- Markdown and notebooks -----------------------------------------------------------------

myst_enable_extensions = ["dollarmath", "colon_fence", "deflist", "html_image"]
myst_heading_anchors = 5
nb_execution_mode = "cache"
nb_execution_raise_on_error = True
nb_execution_timeout = 300
nb_execution_cache_path = str(Path(__file__).parents[1] / "out" / "notebooks")
nb_execution_show_tb = True
nb_merge_streams = True

# ---- Python ---------------------------------------------------------------------------------

autosummary_generate = False
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
add_module_names = False
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88

# Types of other libraries. Their documentation is not there when the site is built without a
# network, so their names are not links.
nitpick_ignore_regex = [
    (r"py:.*", rf"({library})(\..*)?")
    for library in (
        "abc|annotated_types|collections|contextlib|enum|pathlib|types|typing",
        "np|NDArray|av|click|gymnasium|h5py|matplotlib|numpy|pandas|pydantic|scipy|xarray",
    )
]

# ---- HTML -----------------------------------------------------------------------------------

html_theme = "pydata_sphinx_theme"
html_title = f"haselab {release}"
html_static_path = ["sphinx/static"]
templates_path = ["sphinx/templates"]
html_css_files = ["site.css"]
html_js_files = ["site.js"]
html_additional_pages = {"index": "redirect.html"}
html_context = {"default_mode": "auto"}
html_show_sourcelink = False
html_search_scorer = str(Path(__file__).parent / "sphinx/search_scorer.js")
html_show_search_summary = False  # a page from file:// may not read the others
html_copy_source = False
html_sidebars = {f"docs/{page}": [] for page in ("faq", "gallery", "hardware")}  # no pages below
html_last_updated_fmt = None
html_theme_options = {
    "logo": {"text": "haselab"},
    "navbar_align": "left",
    "navbar_end": ["theme-switcher"],
    "header_links_before_dropdown": 8,
    "show_nav_level": 1,
    "navigation_depth": 4,
    "show_toc_level": 2,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
    "navigation_with_keys": False,
    "back_to_top_button": True,
    "pygments_light_style": "a11y-high-contrast-light",
    "pygments_dark_style": "a11y-high-contrast-dark",
}


def _leave_out_empty_patterns(app: Sphinx, docname: str, source: list[str]) -> None:
    """A pattern of a table of contents may find no page: a section may be empty."""
    folder = Path(app.srcdir, docname).parent
    if docname.endswith("index"):
        lines = source[0].splitlines()
        found = [line for line in lines if not re.fullmatch(r"   \S*\*\S*", line)
                 or any(folder.glob(f"{line.strip()}.*"))]  # fmt: skip
        source[0] = "\n".join(found)


def _shorten_paths(app: Sphinx, doctree: nodes.document) -> None:
    """A traceback in a notebook names the files of the checkout, not where it lies."""
    folder = f"{app.srcdir}/"
    for text in list(doctree.findall(nodes.Text)):
        if folder in text:
            parent = text.parent
            parent.replace(text, nodes.Text(text.replace(folder, "")))
            parent.rawsource = parent.rawsource.replace(folder, "")


def setup(app: Sphinx) -> None:
    """Connect what belongs to no extension."""
    app.connect("doctree-read", _shorten_paths)
    app.connect("source-read", _leave_out_empty_patterns)
