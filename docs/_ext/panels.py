"""Directives that show pictures side by side, in the colours of the page."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from pathlib import Path
from typing import Any


def add_directive(
    app: Any, directive: str, draw: Callable[[str], str], names: Collection[str], files: Iterable[Path] = ()
) -> dict[str, bool]:
    """Register a directive whose arguments are names of pictures.

    Parameters
    ----------
    app : Sphinx
    directive : str
        Its name.
    draw : callable
        Takes the name of a picture and returns it as SVG.
    names : collection of str
        The pictures.
    files : iterable of Path
        Files that the pictures depend on.

    Returns
    -------
    dict
        What an extension's ``setup`` returns.
    """
    from docutils import nodes
    from sphinx.util.docutils import SphinxDirective

    class Panels(SphinxDirective):
        """Pictures side by side."""

        required_arguments, optional_arguments = 1, len(names) - 1

        def run(self):
            for path in files:
                self.env.note_dependency(str(path))
            drawn = "".join(draw(name) for name in self.arguments)
            return [nodes.raw("", f'<div class="side-by-side">{drawn}</div>', format="html")]

    app.add_directive(directive, Panels)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
