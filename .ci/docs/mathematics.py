"""Mathematics as MathML, which browsers draw without any script, and so without a network."""

from sphinx.util import logging

LOG = logging.getLogger(__name__)


def setup(app, convert) -> None:
    """Add the renderer `mathml`; convert: function from LaTeX to MathML."""

    def inline(self, node):
        self.body.append(_converted(node, convert, "inline"))
        raise SkipNode

    def block(self, node):
        self.body.append(f"<div class='math'>{_converted(node, convert, 'block')}</div>")
        raise SkipNode

    from docutils.nodes import SkipNode

    app.add_html_math_renderer("mathml", (inline, None), (block, None))


def _converted(node, convert, display: str) -> str:
    text = node.astext()
    try:
        return convert(text, display=display)
    except Exception as error:  # each kind that the converter raises is a mistake in the formula
        LOG.warning("formula %r: %s", text, error, location=node)
        return ""
