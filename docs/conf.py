"""Settings of `sphinx-build -W docs build/site`. Nothing in the built pages is fetched from elsewhere."""

from __future__ import annotations

import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE / "_site"), str(HERE.parent)]

from mjxball import __version__  # noqa: E402

project, author, release = "mjxball", "the mjxball authors", __version__
project_copyright = f"{author}, Apache-2.0"

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "mathml",
    "markdown_docstrings",
    "settings_table",
    "notebooks",
    "generated",
    "values",
]
exclude_patterns = ["_site", "_static"]
html_theme = "furo"
html_title = f"mjxball {release}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_math_renderer = "mathml"  # the browser's own: no script, no font
html_copy_source = False
html_show_search_summary = False  # the search would fetch pages, which browsers refuse for files on disk
html_last_updated_fmt = None

default_role = "code"
myst_enable_extensions = ["dollarmath", "fieldlist"]
myst_heading_anchors = 4
myst_dmath_double_inline = True
smartquotes = False  # which makes a dash of the two before a flag

autodoc_mock_imports = ["jaxmarl"]  # not in the extra `docs`: it brings pandas, and takes 4 s
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88
python_display_short_literal_types = True
