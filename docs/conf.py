"""Sphinx configuration: `make docs` builds the site into docs/_build/html, with warnings as errors."""

import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

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
exclude_patterns = ["_build", "**/.ipynb_checkpoints"]
generate.all_pages(HERE)  # before Sphinx looks for pages

myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence", "deflist", "attrs_inline"]
myst_heading_anchors = 3
nb_execution_mode = "cache"  # a notebook runs again only after it was edited
nb_execution_cache_path = str(HERE / "_build" / "notebooks")
nb_execution_timeout = 120
nb_execution_raise_on_error = True
nb_merge_streams = True

autodoc_typehints = "signature"
autodoc_member_order = "bysource"
default_role = "code"  # docstrings have names between single backquotes
napoleon_google_docstring = True
napoleon_numpy_docstring = False

html_theme = "furo"
html_title = "khop_env"
html_static_path = ["_static"]
copybutton_prompt_text = "$ "
