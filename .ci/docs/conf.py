"""Settings of Sphinx for the documentation; `render.py` gathers the pages and calls it."""

import api
import mathematics
import plain_docstrings
from latex2mathml.converter import convert

import jaxilc

project, author = "jaxilc", "the authors of jaxilc"
version = release = jaxilc.__version__
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx_copybutton"]
if tags.has("pages"):  # noqa: F821, which Sphinx defines
    extensions.append("sphinx.ext.viewcode")  # source links, which lead to pages of this site
html_theme, html_title = "furo", f"jaxilc {release}"
html_static_path, html_css_files = ["_static"], ["pages.css"]
html_js_files = ["pages.js"]
html_extra_path = ["_extra"]  # the live page
html_show_sphinx = html_copy_source = html_show_sourcelink = False
html_math_renderer = "mathml"
myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence", "attrs_inline"]
myst_heading_anchors = 4
nb_execution_mode = "off"  # render.py executes the notebooks, with the same rules as the tests
nb_merge_streams = True
autodoc_member_order = "bysource"
autodoc_typehints, autodoc_typehints_format = "none", "short"
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 160  # longer ones have a line for each parameter
exclude_patterns = ["_build", "_extra"]
templates_path: list[str] = []


def setup(app):
    """Connect what the project adds: MathML, docstrings in plain text, readable signatures."""
    mathematics.setup(app, convert)
    plain_docstrings.setup(app)
    api.setup(app)
