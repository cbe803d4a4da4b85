"""Formulas as MathML, which browsers draw by themselves: no script, no network. Labels ``eq5`` show the number 5."""

from docutils.utils.math.latex2mathml import tex2mathml


def inline(translator, node):
    """Write a formula in a line of text."""
    translator.body.append(tex2mathml(node.astext()))
    raise _skip()


def display(translator, node):
    """Write a formula on a line of its own, with the number in its label."""
    label = node.get("label") or ""
    number = label.removeprefix("eq") if label.startswith("eq") else ""
    translator.body.append(translator.starttag(node, "div", CLASS="math"))
    if number:
        translator.body.append(f'<span class="eqno" id="equation-{label}">({number})</span>')
    translator.body.append(tex2mathml(node.astext(), as_block=True))
    translator.body.append("</div>\n")
    raise _skip()


def _skip():
    from docutils.nodes import SkipNode

    return SkipNode()


def setup(app):
    """Register the renderer."""
    app.add_html_math_renderer("mathml", (inline, None), (display, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
