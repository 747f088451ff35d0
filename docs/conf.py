"""The documentation: ``python -m sphinx -W -c docs . docs/build``."""

import re

from sphinx.util.inspect import TypeAliasForwardRef

import jast

project, author, copyright = "jast", "the authors of jast", "the authors of jast"
version = release = jast.__version__
extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
]
root_doc = "docs/index"
abouts = ["CHANGELOG.md", "CODE_OF_CONDUCT.md", "CONTRIBUTING.md", "SECURITY.md"]
include_patterns = ["docs/**", "notebooks/**", *abouts]
exclude_patterns = ["docs/build"]
html_theme, html_title = "sphinx_book_theme", "jast"
html_static_path, html_css_files = ["static"], ["page.css"]

nb_execution_mode = "off"  # notebooks are committed with what they printed
myst_enable_extensions = ["attrs_inline", "dollarmath"]
myst_heading_anchors = 3

default_role = "py:obj"
suppress_warnings = ["ref.python"]  # a word in backticks may be the name of several fields
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
TypeAliasForwardRef.__repr__ = lambda self: self.name  # also in unions
autodoc_type_aliases = {name: name for name in ("Array", "ArrayTree", "Numeric", "PRNGKey")}
python_maximum_signature_line_length = 90
napoleon_numpy_docstring = False


def _bars(app, what, name, obj, options, lines):
    """Docstrings write |x| for an absolute value, which is no substitution."""
    lines[:] = [re.sub(r"(``.*?``)|\|", lambda m: m[1] or r"\|", line) for line in lines]


def _others(app, what, name, obj, skip, options):
    """Names of other packages have their own documentation."""
    module = getattr(obj, "__module__", None)
    return skip or (isinstance(module, str) and module.split(".")[0] in ("distrax", "jax"))


def setup(app):
    app.connect("autodoc-process-docstring", _bars)
    app.connect("autodoc-skip-member", _others)
