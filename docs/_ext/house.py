"""Picture of the packages and what they import, made from the imports of the code when the pages are built.

`rooms` and `arrows` need no Sphinx; `setup` registers the directive ``{house}``.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from html import escape
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
GROUND = ("errors", "files", "geometry", "version", "warn")
"""Rooms of the ground floor that every room imports: drawn as one box."""
FACES = ("__init__", "__main__", "derived", "statistics")
"""Files that only hand public names on: not drawn."""
WIDTH, BOX_WIDTH, BOX_HEIGHT, STOREY = 760, 138, 44, 84
"""Sizes of the picture, of a box, and distance of floors [pixel]."""


def rooms() -> dict[str, int]:
    """Lines of Python in each room: the folders of ``lfpiv``, its ground, and ``lfpiv_kernels``."""
    lines: dict[str, int] = {}
    for path, room in _files():
        lines[room] = lines.get(room, 0) + len(path.read_text("utf-8").splitlines())
    return lines


def arrows() -> dict[str, set[str]]:
    """Rooms that each room imports."""
    found: dict[str, set[str]] = {room: set() for room in rooms()}
    for path, room in _files():
        for name in _imported(ast.parse(path.read_text("utf-8"))):
            parts = name.split(".")
            other = _room(parts[1]) if parts[0] == "lfpiv" and len(parts) > 1 else parts[0]
            if other in found and other != room:
                found[room].add(other)
    return found


def floors(found: Mapping[str, set[str]]) -> dict[str, int]:
    """Floor of each room: one above the highest room that it imports; 1 is the ground."""
    height: dict[str, int] = {}
    while len(height) < len(found):
        ready = [room for room, others in found.items() if room not in height and others <= set(height)]
        if not ready:
            raise ValueError(f"a circle of imports among {sorted(set(found) - set(height))}")
        height |= {room: 1 + max((height[other] for other in found[room]), default=0) for room in ready}
    return height


def svg() -> str:
    """Draw the rooms on their floors. An arrow that follows from others is left out."""
    found, lines = arrows(), rooms()
    height = floors(found)
    top = max(height.values())
    place: dict[str, tuple[float, float]] = {}
    for floor in range(1, top + 1):
        row = sorted((room for room in found if height[room] == floor), key=lambda room: _order(room, found, place))
        for number, room in enumerate(row):
            x = WIDTH * (number + 0.5) / len(row) if len(row) > 1 else WIDTH / 2
            place[room] = (x, (top - floor) * STOREY + BOX_HEIGHT / 2 + 4)
    parts = []
    for room, others in found.items():
        for other in sorted(others):
            if not any(_reaches(found, between, other) for between in others - {other}):
                parts.append(_line(place[room], place[other]))
    for room, (x, y) in place.items():
        title = f"{', '.join(GROUND)}" if room == "ground" else room
        parts.append(_box(x, y, title, lines[room], wide=room == "ground"))
    tall = (top - 1) * STOREY + BOX_HEIGHT + 8
    return (
        f'<svg class="house" viewBox="0 0 {WIDTH} {tall}" role="img" aria-label="Packages and their imports" '
        f'style="max-width:100%;height:auto" font-family="sans-serif" font-size="13">{"".join(parts)}</svg>'
    )


def _files() -> Iterator[tuple[Path, str]]:
    for path in sorted((ROOT / "lfpiv").rglob("*.py")):
        name = path.relative_to(ROOT / "lfpiv").parts[0].removesuffix(".py")
        if name not in FACES:
            yield path, _room(name)
    for path in sorted((ROOT / "lfpiv_kernels").rglob("*.py")):
        yield path, "lfpiv_kernels"


def _room(name: str) -> str:
    return "ground" if name in GROUND else name


def _imported(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def _reaches(found: Mapping[str, set[str]], start: str, end: str) -> bool:
    return end in found[start] or any(_reaches(found, other, end) for other in found[start])


def _order(room: str, found: Mapping[str, set[str]], place: Mapping[str, tuple[float, float]]) -> tuple[float, str]:
    """Sort rooms of a floor by the mean position of what they import, so that few arrows cross."""
    below = [place[other][0] for other in found[room] if other in place]
    return (sum(below) / len(below) if below else 0.0, room)


def _line(start: tuple[float, float], end: tuple[float, float]) -> str:
    (x0, y0), (x1, y1) = start, end
    y0, y1 = y0 + BOX_HEIGHT / 2, y1 - BOX_HEIGHT / 2
    bend = (y1 - y0) / 2
    return (
        f'<path d="M{x0:.0f} {y0:.0f} C{x0:.0f} {y0 + bend:.0f} {x1:.0f} {y1 - bend:.0f} {x1:.0f} {y1 - 5:.0f}" '
        'fill="none" stroke="currentColor" stroke-opacity=".45"/>'
        f'<path d="M{x1 - 3:.0f} {y1 - 6:.0f} L{x1 + 3:.0f} {y1 - 6:.0f} L{x1:.0f} {y1:.0f} Z" fill="currentColor"/>'
    )


def _box(x: float, y: float, title: str, lines: int, *, wide: bool) -> str:
    half = 1.6 * BOX_WIDTH / 2 if wide else BOX_WIDTH / 2
    return (
        f'<rect x="{x - half:.0f}" y="{y - BOX_HEIGHT / 2:.0f}" width="{2 * half:.0f}" height="{BOX_HEIGHT}" rx="5" '
        'fill="var(--color-background-secondary, #f4f6f8)" stroke="currentColor" stroke-opacity=".6"/>'
        f'<text x="{x:.0f}" y="{y - 2:.0f}" text-anchor="middle" fill="currentColor">{escape(title)}</text>'
        f'<text x="{x:.0f}" y="{y + 14:.0f}" text-anchor="middle" fill="currentColor" fill-opacity=".65" '
        f'font-size="11">{lines:,} lines</text>'
    )


def setup(app):
    """Register the directive."""
    from docutils import nodes
    from sphinx.util.docutils import SphinxDirective

    class House(SphinxDirective):
        """The picture."""

        def run(self):
            return [nodes.raw("", svg(), format="html")]

    app.add_directive("house", House)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
