"""Picture of the packages and what they import, made from the imports of the code when the pages are built.

`svg` needs no Sphinx; `setup` registers the directive ``{house}``. Long arrows pass between the boxes of the floors
that they cross: each takes a narrow place there (layered drawing of Sugiyama, Tagawa and Toda, 1981).
"""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from html import escape
from importlib.util import find_spec
from itertools import combinations, pairwise
from pathlib import Path

ROOT = Path(find_spec("lfpiv").origin).parents[1]
"""Folder of the packages: these pages are also built from a copy that lies elsewhere."""
GROUND = ("errors", "files", "geometry", "progress", "version", "warn")
"""Rooms of the ground floor that every room imports: drawn as one box."""
FACES = ("__init__", "__main__", "derived", "statistics")
"""Files that only hand public names on: not drawn."""
BOX_WIDTH, GROUND_WIDTH, BOX_HEIGHT, STOREY = 104, 164, 52, 92
"""Widths of a room's box and of the ground's, their height, and the distance of floors [pixel]."""
LANE, GAP = 4, 12
"""Width of an arrow that passes a floor, and least distance of neighbours [pixel]."""
SWEEPS = 24
"""Passes over the floors, down and up, that sort and place their boxes."""

Spot = str | tuple[str, str, int]
"""A room, or where an arrow from one room to another passes a floor."""


def rooms() -> dict[str, int]:
    """Count the lines of Python in each room: the folders of ``lfpiv``, its ground, and ``lfpiv_kernels``."""
    lines: dict[str, int] = {}
    for path, room in _files():
        lines[room] = lines.get(room, 0) + len(path.read_text("utf-8").splitlines())
    return lines


def arrows() -> dict[str, set[str]]:
    """Find the rooms that each room imports."""
    found: dict[str, set[str]] = {room: set() for room in rooms()}
    for path, room in _files():
        for name in _imported(ast.parse(path.read_text("utf-8"))):
            parts = name.split(".")
            other = _room(parts[1]) if parts[0] == "lfpiv" and len(parts) > 1 else parts[0]
            if other in found and other != room:
                found[room].add(other)
    return found


def floors(found: Mapping[str, set[str]]) -> dict[str, int]:
    """Return the floor of each room: one above the highest room that it imports; 1 is the ground."""
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
    ways = [
        [start, *((start, end, floor) for floor in range(height[start] - 1, height[end], -1)), end]
        for start, others in found.items()
        for end in sorted(others)
        if not any(_reaches(found, between, end) for between in others - {end})
    ]
    rows = _sorted_rows(height, ways)
    across = _places(rows, ways)
    top = len(rows)
    place = {
        spot: (across[spot], (top - floor) * STOREY + BOX_HEIGHT / 2 + 4)
        for floor, row in enumerate(rows, start=1)
        for spot in row
    }
    parts = [_line([place[spot] for spot in way]) for way in ways]
    parts += [_box(*place[room], room, lines[room]) for room in found]
    left = min(across[spot] - _width(spot) / 2 for spot in across) - 4
    wide = max(across[spot] + _width(spot) / 2 for spot in across) + 4 - left
    tall = (top - 1) * STOREY + BOX_HEIGHT + 8
    return (
        f'<svg class="house" viewBox="{left:.0f} 0 {wide:.0f} {tall}" style="width:100%;max-width:{1.2 * wide:.0f}px" '
        f'role="img" aria-label="Packages and their imports" font-family="sans-serif">{"".join(parts)}</svg>'
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


def _sorted_rows(height: Mapping[str, int], ways: list[list[Spot]]) -> list[list[Spot]]:
    """Sort the spots of each floor, ground first, by the mean place of their neighbours, so that few arrows cross."""
    rows: list[list[Spot]] = [
        [room for room in sorted(height) if height[room] == floor + 1] for floor in range(max(height.values()))
    ]
    for way in ways:
        for spot in way[1:-1]:
            rows[spot[2] - 1].append(spot)
    best, fewest = [list(row) for row in rows], _crossings(rows, ways)
    for sweep in range(SWEEPS):
        down = sweep % 2 == 0
        for row in reversed(rows[:-1]) if down else rows[1:]:
            rank = {spot: number / len(other) for other in rows for number, spot in enumerate(other)}
            row.sort(key=lambda spot: _mean([rank[near] for near in _neighbours(spot, ways, above=down)], rank[spot]))
        if (count := _crossings(rows, ways)) < fewest:
            best, fewest = [list(row) for row in rows], count
    return best


def _crossings(rows: list[list[Spot]], ways: list[list[Spot]]) -> int:
    rank = {spot: number for row in rows for number, spot in enumerate(row)}
    floor = {spot: number for number, row in enumerate(rows) for spot in row}
    steps = {step for way in ways for step in pairwise(way)}
    return sum(
        floor[a] == floor[c] and (rank[a] - rank[c]) * (rank[b] - rank[d]) < 0
        for (a, b), (c, d) in combinations(steps, 2)
    )


def _neighbours(spot: Spot, ways: list[list[Spot]], *, above: bool) -> list[Spot]:
    steps = [step for way in ways for step in pairwise(way)]
    return [a for a, b in steps if b == spot] if above else [b for a, b in steps if a == spot]


def _mean(values: list[float], otherwise: float) -> float:
    return sum(values) / len(values) if values else otherwise


def _places(rows: list[list[Spot]], ways: list[list[Spot]]) -> dict[Spot, float]:
    """Place the spots of each floor near the mean of their neighbours, in order and without overlap [pixel]."""
    across = {spot: BOX_WIDTH * (number - len(row) / 2) for row in rows for number, spot in enumerate(row)}
    for sweep in range(SWEEPS):
        for row in reversed(rows) if sweep % 2 == 0 else rows:
            wanted = [
                _mean(
                    [across[near] for above in (True, False) for near in _neighbours(spot, ways, above=above)],
                    across[spot],
                )
                for spot in row
            ]
            across |= zip(row, _apart(wanted, [_width(spot) for spot in row]), strict=True)
    return across


def _apart(wanted: list[float], widths: list[float]) -> list[float]:
    """Move places as little as possible (least squares) until boxes of these widths do not overlap."""
    offsets = [sum(widths[:i]) + i * GAP + widths[i] / 2 for i in range(len(widths))]
    blocks: list[list[float]] = []
    for value in (place - offset for place, offset in zip(wanted, offsets, strict=True)):
        blocks.append([value])
        while len(blocks) > 1 and _mean(blocks[-2], 0) > _mean(blocks[-1], 0):
            blocks[-2:] = [blocks[-2] + blocks[-1]]
    starts = [_mean(block, 0) for block in blocks for _ in block]
    return [start + offset for start, offset in zip(starts, offsets, strict=True)]


def _width(spot: Spot) -> float:
    return LANE if isinstance(spot, tuple) else GROUND_WIDTH if spot == "ground" else BOX_WIDTH


def _line(spots: list[tuple[float, float]]) -> str:
    """Draw an arrow that passes the floors between its ends upright."""
    half = BOX_HEIGHT / 2
    path, last = "", len(spots) - 2
    for number, ((x0, y0), (x1, y1)) in enumerate(pairwise(spots)):
        start, end = y0 + half, y1 - half - (5 if number == last else 0)
        bend = (end - start) / 2
        path += f"{'L' if number else 'M'}{x0:.0f} {start:.0f} "
        path += f"C{x0:.0f} {start + bend:.0f} {x1:.0f} {end - bend:.0f} {x1:.0f} {end:.0f} "
    x, y = spots[-1][0], spots[-1][1] - half
    return (
        f'<path d="{path}" fill="none" stroke="currentColor" stroke-opacity=".45"/>'
        f'<path d="M{x - 3:.0f} {y - 6:.0f} L{x + 3:.0f} {y - 6:.0f} L{x:.0f} {y:.0f} Z" fill="currentColor"/>'
    )


def _box(x: float, y: float, room: str, lines: int) -> str:
    wide, half = _width(room), len(GROUND) // 2
    titles = [", ".join(GROUND[:half]) + ",", ", ".join(GROUND[half:])] if room == "ground" else [room]
    texts = [(title, 13, 1) for title in titles] + [(f"{lines:,} lines", 11, 0.65)]
    first = y + 4 - 8 * (len(texts) - 1)
    return (
        f'<g class="room-{room}"><rect x="{x - wide / 2:.0f}" y="{y - BOX_HEIGHT / 2:.0f}" width="{wide}" '
        f'height="{BOX_HEIGHT}" rx="5" fill="var(--color-background-secondary, #f4f6f8)" stroke="currentColor" '
        'stroke-opacity=".6"/>'
        + "".join(
            f'<text x="{x:.0f}" y="{first + 16 * number:.0f}" text-anchor="middle" fill="currentColor" '
            f'fill-opacity="{opacity}" font-size="{size}">{escape(text)}</text>'
            for number, (text, size, opacity) in enumerate(texts)
        )
        + "</g>"
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
