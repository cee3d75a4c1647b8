"""Settings of Sphinx for the documentation; `render.py` gathers the pages and calls it."""

import mathematics
import plain_docstrings
from latex2mathml.converter import convert

import jaxilc

project, author = "jaxilc", "the authors of jaxilc"
version = release = jaxilc.__version__
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx_copybutton"]
html_theme, html_title = "furo", f"jaxilc {release}"
html_static_path, html_css_files = ["_static"], ["pages.css"]
html_show_sphinx = html_copy_source = html_show_sourcelink = False
html_math_renderer = "mathml"
myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence"]
myst_heading_anchors = 4
nb_execution_mode = "off"  # render.py executes the notebooks, with the same rules as the tests
nb_merge_streams = True
autodoc_member_order = "bysource"
autodoc_typehints, autodoc_typehints_format = "signature", "short"
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 80
exclude_patterns = ["_build"]
templates_path: list[str] = []


def setup(app):
    """Connect the two extensions of the project: MathML, and docstrings in plain text."""
    mathematics.setup(app, convert)
    plain_docstrings.setup(app)
