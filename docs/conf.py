"""Sphinx configuration: `make docs` builds the site into docs/_build/html, with warnings as errors."""

import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

import docstrings  # noqa: E402  (docs/docstrings.py)
import generate  # noqa: E402  (docs/generate.py)

import khop_env  # noqa: E402

project = "khop_env"
author = "The khop_env developers"
copyright = "The khop_env developers"
version = release = khop_env.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinx_design",
]
exclude_patterns = ["_build", "**/.ipynb_checkpoints", "benchmarks/tables"]
generate.all_pages(HERE)  # before Sphinx looks for pages

myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence", "deflist", "attrs_inline"]
myst_heading_anchors = 3
nb_execution_mode = "cache"  # a notebook runs again only after it was edited
nb_execution_cache_path = str(HERE / "_build" / "notebooks")
nb_execution_timeout = 120
nb_execution_raise_on_error = True
nb_merge_streams = True
nb_output_stderr = "remove"  # on a new machine the first cells say there that kernels are being compiled

autodoc_default_options = {"members": True, "special-members": "__call__", "no-value": True}
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_typehints = "signature"
ALIASES = "ArrayLike FloatArray Float32Array IntArray IndexArray Bound Bounds ChannelMemory Environment Infos Margin"
autodoc_type_aliases = {name: name for name in (*ALIASES.split(), "Memory", "Span")}
default_role = "code"  # docstrings have names between single backquotes
# a list, as that of arguments
napoleon_custom_sections = [(name, "params_style") for name in ("Attributes", "Columns", "Keys")]
napoleon_google_docstring = True
napoleon_numpy_docstring = False
python_maximum_signature_line_length = 100
python_use_unqualified_type_names = True
toc_object_entries_show_parents = "hide"

smartquotes_action = "D"  # dashes only: quotes in docstrings are Python's
html_theme = "furo"
html_title = "khop_env"
html_static_path = ["_static"]
html_css_files = ["site.css"]
copybutton_prompt_text = "$ "


def setup(app):
    """Called by Sphinx."""
    app.connect("autodoc-process-docstring", docstrings.markup, priority=400)  # before napoleon's handler
    app.connect("autodoc-process-signature", docstrings.signature)
    app.connect("autodoc-skip-member", docstrings.skip)
    app.connect("doctree-resolved", docstrings.other_types)
    app.connect("html-page-context", docstrings.back_links)
