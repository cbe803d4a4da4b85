"""Drawings of the rig, of a ray, of a microimage and of the board, in the colours of the page, light or dark.

`draw` needs no Sphinx; `setup` registers the directive ``{drawing} NAME ...``. Lengths are not to scale.
"""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Polygon, Rectangle
from panels import add_directive

from lfpiv.report import svg

INK = svg.INK
BLUE, ORANGE, GREEN = svg.SERIES[:3]
LETTER_F = np.array([(0, 0), (0, 5), (3, 5), (3, 4), (1, 4), (1, 3), (2.4, 3), (2.4, 2), (1, 2), (1, 0)]) / 5 - (
    0.3,
    0.5,
)
"""Outline of an F, which differs from all its mirror images."""


def _text(
    axes: Axes, x: float, y: float, text: str, *, colour: str = INK, place: str = "center", above: str = "center"
):
    axes.text(x, y, text, color=colour, ha=place, va=above, fontsize=svg.SMALL_POINT)


def _arrow(axes: Axes, start: tuple[float, float], end: tuple[float, float], colour: str = INK, style: str = "-|>"):
    properties = {"arrowstyle": style, "color": colour, "lw": 1.2, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 9}
    axes.annotate("", end, start, arrowprops=properties)


def _plain(axes: Axes, width: tuple[float, float], height: tuple[float, float]) -> None:
    axes.set_xlim(*width)
    axes.set_ylim(*height)
    axes.set_aspect("equal")
    axes.axis("off")
    axes.patch.set_alpha(0)


def rig(axes: Axes) -> str:
    """Draw the rig from above."""
    _plain(axes, (-5.2, 5.2), (-2.4, 6.4))
    axes.add_patch(Rectangle((-1.2, -0.6), 2.4, 1.2, fill=False, ec=BLUE, lw=1.4))
    _text(axes, 0, -0.95, "volume", colour=BLUE)
    for offset in (-1.5, 0.0, 1.5):
        axes.plot([-2.2, 2.2], [offset, offset], color=GREEN, lw=1.0 if offset else 1.4, ls="--" if offset else "-")
    _text(axes, -2.3, 0, "board, z = 0", colour=GREEN, place="right")
    _text(axes, -2.3, -1.5, "z = -2", colour=GREEN, place="right")
    _text(axes, -2.3, 1.5, "z = 2", colour=GREEN, place="right")
    for sign in (-1, 1):
        along = np.array([sign * np.sin(np.radians(40)), np.cos(np.radians(40))])
        aside = np.array([along[1], -along[0]])
        lens, back = 4.6 * along, 6.0 * along
        axes.plot(*np.array([0 * along, lens]).T, color=INK, lw=0.8, ls=":")
        axes.plot(*np.array([lens - 0.55 * aside, lens + 0.55 * aside]).T, color=ORANGE, lw=2.2)
        box = [lens - 0.7 * aside, lens + 0.7 * aside, back + 0.7 * aside, back - 0.7 * aside]
        axes.add_patch(Polygon(box, fill=False, ec=ORANGE, lw=1.4))
        _text(axes, *(5.3 * along), "right" if sign > 0 else "left", colour=ORANGE)
    _arrow(axes, (0, 0), (0, 3.6))
    _arrow(axes, (0, 0), (3.4, 0))
    _text(axes, 0.15, 3.7, "z, depth", place="left", above="bottom")
    _text(axes, 3.5, 0, "x", place="left")
    axes.plot(0, 0, "o", ms=6, mfc="none", color=INK)
    axes.plot(0, 0, ".", ms=3, color=INK)
    _text(axes, 0.2, -0.3, "y, up", place="left")
    turn = np.radians(np.linspace(90, 50, 20))
    axes.plot(2.5 * np.cos(turn), 2.5 * np.sin(turn), color=INK, lw=0.8)
    _text(axes, 0.95, 2.75, "α > 0")
    _text(axes, -0.95, 2.75, "α < 0")
    axes.set_title("the rig from above", color=INK, fontsize=svg.TEXT_POINT)
    return "The rig from above: z points from the volume to the cameras, x to the right, the board lies normal to z"


def flips(axes: Axes) -> str:
    """Draw how pictures show an F for each value of ``image_flip``."""
    _plain(axes, (-0.4, 4.2), (-1.75, 1.9))
    names = ("none", "horizontal", "vertical", "both")
    turned = {"none": (-1, 1), "horizontal": (1, 1), "vertical": (-1, -1), "both": (1, -1)}
    for number, name in enumerate(names):
        middle = np.array([0.35 + 1.12 * number, 0.35])
        axes.add_patch(Rectangle(middle - 0.45, 0.9, 0.9, fill=False, ec=INK, lw=1.0))
        axes.add_patch(Polygon(middle + 0.66 * LETTER_F * turned[name], fc=BLUE, ec="none"))
        _text(axes, middle[0], -0.3, f'"{name}"')
    for number, text in enumerate(("mirrored", "as seen", "upside\ndown", "mirrored,\nupside\ndown")):
        _text(axes, 0.35 + 1.12 * number, -0.5, text, above="top")
    _text(axes, 2.0, 1.35, "An F that stands upright, as the recorded picture\nshows it, and image_flip for it:")
    return "Recorded pictures of an upright F, and the value of image_flip for each of them"


def ray(axes: Axes) -> str:
    """Draw one ray from a voxel through main lens and microlens to a pixel."""
    _plain(axes, (-5.6, 5.4), (-3.3, 3.6))
    point, pupil, meeting, pixel = (-4.6, 1.1), (-0.4, 1.9), (3.3, -0.75), (4.55, -1.62)
    axes.add_patch(Rectangle((point[0] - 0.25, point[1] - 0.25), 0.5, 0.5, fill=False, ec=BLUE, lw=1.4))
    _text(axes, point[0], point[1] + 0.45, "voxel\n(x, y, z)", colour=BLUE, above="bottom")
    axes.plot([-5.5, 5.2], [0, 0], color=INK, lw=0.7, ls=":")
    axes.plot([pupil[0]] * 2, [-2.5, 2.5], color=ORANGE, lw=2.4)
    _text(axes, pupil[0], 2.65, "main lens", colour=ORANGE, above="bottom")
    centres = np.linspace(-2.25, 2.25, 7)
    for centre in centres:
        bow = np.linspace(-0.36, 0.36, 9)
        axes.plot(meeting[0] + 0.14 * (1 - (bow / 0.36) ** 2), centre + bow, color=GREEN, lw=1.4)
        axes.plot(meeting[0] - 0.14 * (1 - (bow / 0.36) ** 2), centre + bow, color=GREEN, lw=1.4)
    _text(axes, meeting[0] + 0.45, 2.75, "microlenses", colour=GREEN, place="right", above="bottom")
    axes.plot([pixel[0]] * 2, [-2.6, 2.6], color=INK, lw=1.2)
    for row in np.linspace(-2.6, 2.6, 27):
        axes.plot([pixel[0], pixel[0] + 0.12], [row, row], color=INK, lw=0.6)
    _text(axes, pixel[0] - 0.45, 2.75, "sensor", place="left", above="bottom")
    axes.plot(*np.array([point, pupil, meeting, pixel]).T, color=BLUE, lw=1.6)
    for at, text, place in ((pupil, "(u, v)", "left"), (meeting, "(s, t)", "right"), (pixel, "X", "left")):
        axes.plot(*at, "o", ms=4, color=BLUE)
        shift = 0.25 if place == "left" else -0.3
        _text(axes, at[0] + shift, at[1] + (0.25 if at is pupil else -0.15), text, colour=BLUE, place=place)
    for start, end, text in (
        (-4.6, -0.4, r"$s_o - z_c$"),
        (-0.4, 3.3, r"$s_i$"),
        (3.3, 4.55, r"$f_m$"),
    ):
        _arrow(axes, (start, -2.75), (end, -2.75), style="<|-|>")
        _text(axes, (start + end) / 2, -3.05, text)
    axes.set_title("one ray from a voxel to a pixel", color=INK, fontsize=svg.TEXT_POINT)
    return (
        "A ray leaves a voxel, crosses the main lens at (u, v), meets the microlens array at (s, t) and the sensor at X"
    )


def microimage(axes: Axes) -> str:
    """Draw microimages, their pixels, and the centres of their lenses."""
    _plain(axes, (-0.2, 9.2), (-1.6, 7.0))
    pitch, pixels = 3.0, 7
    for column in range(3):
        for row in range(2):
            centre = np.array([1.5 + pitch * column, 1.5 + pitch * row])
            axes.add_patch(Circle(centre, 1.42, fill=False, ec=ORANGE, lw=1.2))
    edge = 2 * 1.42 / pixels
    for row in range(pixels):
        for column in range(pixels):
            place = np.array([4.5, 1.5]) + ((column - 3) * edge, (row - 3) * edge)
            if np.hypot(*(place - (4.5, 1.5))) < 1.42:
                chosen = (column, row) == (5, 4)
                style = {"fc": BLUE if chosen else "none", "ec": INK, "lw": 0.4}
                axes.add_patch(Rectangle(place - edge / 2, edge, edge, **style))
    for column in range(3):
        for row in range(2):
            if (column, row) != (1, 0):
                place = np.array([1.5 + pitch * column, 1.5 + pitch * row]) + (2 * edge, edge)
                axes.add_patch(Rectangle(place - edge / 2, edge, edge, fc=BLUE, ec="none", alpha=0.45))
    for column, shift in enumerate((0.22, 0.0, -0.22)):
        for row in range(2):
            axes.plot(1.5 + pitch * column + shift, 1.5 + pitch * row, "+", color=GREEN, ms=7, mew=1.4)
    _text(axes, 4.5, 6.35, "microimages: images of the pupil", colour=ORANGE, above="bottom")
    _text(
        axes,
        4.5,
        -0.15,
        "a pixel is a pupil point (u, v); the same one of all lenses\nis a sub-aperture view",
        colour=BLUE,
        above="top",
    )
    _text(axes, 4.5, -1.1, "+ centre of the lens: lenses lie closer than microimages", colour=GREEN, above="top")
    return (
        "Microimages are images of the pupil; the same pixel of all microimages makes a view; lens centres lie closer"
    )


def board(axes: Axes) -> str:
    """Draw the board's dots with a mark, its axes and names."""
    _plain(axes, (-4.6, 4.8), (-4.4, 4.2))
    axes.add_patch(Rectangle((-3.6, -3.6), 7.2, 7.2, fill=False, ec=INK, lw=1.0))
    for column in range(-3, 4):
        for row in range(-3, 4):
            missing = (column, row) in ((0, 1), (1, 0), (2, 0))
            face = {"fc": "none", "ls": ":"} if missing else {"fc": GREEN, "ls": "-"}
            axes.add_patch(Circle((column, row), 0.17, ec=GREEN, lw=0.8, **face))
    _arrow(axes, (0, 0), (0, 4.0))
    _arrow(axes, (0, 0), (4.3, 0))
    _text(axes, 0.2, 4.0, "y", place="left")
    _text(axes, 4.4, 0.1, "x", place="left")
    _arrow(axes, (-3, -3.95), (-2, -3.95), style="<|-|>")
    _text(axes, -1.8, -3.97, "spacing_mm", place="left")
    _text(axes, 3.6, -3.97, "dots = [7, 7]", place="right")
    axes.set_title("the board; dotted: a mark, sites without a dot", color=INK, fontsize=svg.TEXT_POINT)
    return "A board of seven by seven dots whose middle is the origin, with a mark of three sites without a dot"


DRAWINGS = {
    "rig": (rig, 3.2),
    "flips": (flips, 2.8),
    "ray": (ray, 2.6),
    "microimage": (microimage, 3.2),
    "board": (board, 3.2),
}
"""Drawings by name, with their heights [inch]."""


def draw(name: str) -> str:
    """Return one of `DRAWINGS` as SVG."""
    drawing, height_inch = DRAWINGS[name]
    figure, axes = svg.new_panel(height_inch)
    alt = drawing(axes)
    return svg.to_svg(figure, alt)


def setup(app):
    """Register the directive."""
    return add_directive(app, "drawing", draw, DRAWINGS)
