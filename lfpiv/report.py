"""`write_report`: one self-contained HTML page for people, its pictures inside."""

from __future__ import annotations

import base64
import html
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lfpiv import dataset, figures
from lfpiv.experiment import CameraSetup, Experiment
from lfpiv.rig import Optics

if TYPE_CHECKING:
    from lfpiv.calibration import CalibratedCamera, Calibration

log = logging.getLogger(__name__)

RIM_POINTS = 48
"""Points on the pupil's edge that draw the outline of a dot's light."""

CSS_DPI = 96
"""Pixels of a web page per inch of a figure."""
ENLARGED = 1.6
"""Width of a figure at full size over its own: what its resolution still holds sharply."""

_STYLE = """
:root { color-scheme: light dark; --page: #ffffff; --card: #f5f6f8; --ink: #1b1f24; --quiet: #5b6570; --line: #d9dee4;
        --warn: #fff4d6; --warn-line: #d9a400; --accent: #1f6fc4; }
@media (prefers-color-scheme: dark) {
  :root { --page: #14171b; --card: #1d2126; --ink: #e4e8ec; --quiet: #98a2ad; --line: #30363d;
          --warn: #33290c; --warn-line: #c99a1c; --accent: #6fb1f5; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--page); color: var(--ink);
       font: 15px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
main { max-width: 1080px; margin: 0 auto; padding: 28px 20px 60px; }
h1 { font-size: 25px; margin: 0 0 2px; } h2 { font-size: 19px; margin: 40px 0 8px; border-bottom: 1px solid var(--line);
     padding-bottom: 4px; } h3 { font-size: 15px; margin: 22px 0 4px; }
p { margin: 6px 0; } .quiet { color: var(--quiet); }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(150px, 1fr)); gap: 10px; margin: 18px 0 6px; }
.card { background: var(--card); border-radius: 8px; padding: 10px 14px; }
.card b { display: block; font-size: 21px; font-weight: 600; } .card span { color: var(--quiet); font-size: 13px; }
.warnings { background: var(--warn); border-left: 4px solid var(--warn-line); border-radius: 4px;
            padding: 8px 16px; margin: 16px 0; }
.warnings ul { margin: 4px 0; padding-left: 20px; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; margin: 8px 0; font-variant-numeric: tabular-nums; }
th, td { text-align: right; padding: 4px 12px; border-bottom: 1px solid var(--line); white-space: nowrap; }
th:first-child, td:first-child { text-align: left; padding-left: 0; } th { color: var(--quiet); font-weight: 500; }
figure { margin: 12px 0 18px; } figure img { max-width: 100%; height: auto; display: block; }
.zoom { display: block; overflow-x: auto; cursor: zoom-in; }
.zoom input { position: absolute; opacity: 0; }
.zoom:has(input:checked) { cursor: zoom-out; } .zoom:has(input:focus-visible) { outline: 2px solid var(--accent); }
.zoom input:checked + img { max-width: none; width: var(--full); }
.zoom::after { content: "click for full size"; position: sticky; left: 0; color: var(--quiet); font-size: 12.5px; }
.zoom:has(input:checked)::after { content: "click to fit the page"; }
@media (max-width: 760px) {
  main { padding: 16px 14px 40px; }
  .zoom img { max-width: none; }
  .zoom::after { content: "scroll sideways, or tap to fit the screen"; }
  .zoom input:checked + img { max-width: 100%; width: auto; }
  .zoom:has(input:checked)::after { content: "tap to enlarge"; } }
@media print { .zoom::after { content: none; } }
figcaption { color: var(--quiet); font-size: 13.5px; max-width: 860px; }
details { margin: 10px 0; } summary { cursor: pointer; color: var(--accent); }
code { font-size: 13px; }
"""


def write_report(
    experiment: Experiment,
    calibration: Calibration,
    summary: Mapping[str, Any],
    vectors: Mapping[int, Path],
    path: Path,
) -> None:
    """Write the report of a run.

    Parameters
    ----------
    experiment : Experiment
        What was run; its white and board images are shown.
    calibration : Calibration
        The calibration that was used.
    summary : dict
        The content of ``summary.json``.
    vectors : dict
        Pair -> file of its vectors; the first one is shown in full.
    path : Path
        Target; written whole or not at all.
    """
    parts = [_head(experiment, summary), _warnings(summary["warnings"]), _what_was_run(experiment, summary)]
    parts.append(_calibration_section(experiment, calibration, summary))
    if vectors:
        parts.append(_volume_section(vectors))
        parts.append(_vector_section(vectors, summary))
    else:
        parts.append("<h2>Vectors</h2><p>No pair is finished yet.</p>")
    parts += [_timings(summary), _small_print(summary)]
    title = html.escape(f"{experiment.name}: light-field PIV")
    dataset.write_text(
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<style>{_STYLE}</style></head><body><main>\n" + "\n".join(parts) + "\n</main></body></html>\n",
        path,
    )


def _head(experiment: Experiment, summary: Mapping[str, Any]) -> str:
    pairs = len(summary["pairs"])
    cards = [(str(pairs), f"image {'pair' if pairs == 1 else 'pairs'} finished")]
    if summary["pairs"]:
        cards.append((_percent(summary["valid_fraction"]), "valid vectors"))
        cards.append(
            (_number(_mean(pair["uncertainty_voxel"] for pair in summary["pairs"]), 2), "voxel median uncertainty")
        )
    sigma = [report["sigma_nor_test"] for report in summary["calibration"].values()]
    found = sum(report["dots_found"] for report in summary["calibration"].values())
    expected = sum(report["dots_expected"] for report in summary["calibration"].values())
    cards.append((_number(max(sigma), 4), "pitch σ_nor on held-out dots, worst camera"))
    cards.append((f"{found} / {expected}", "board dots found"))
    boxes = "".join(
        f'<div class="card"><b>{html.escape(value)}</b><span>{label}</span></div>' for value, label in cards
    )
    return (
        f"<h1>{html.escape(experiment.name)}</h1>"
        f'<p class="quiet">Multi-camera light-field PIV, {_count(len(experiment.cameras), "camera")}, '
        f"lfpiv {html.escape(summary['versions']['lfpiv'])}</p>"
        f'<div class="cards">{boxes}</div>'
    )


def _warnings(texts: Sequence[str]) -> str:
    if not texts:
        return ""
    items = "".join(f"<li>{html.escape(text)}</li>" for text in texts)
    return f'<div class="warnings"><b>Warnings</b><ul>{items}</ul></div>'


def _what_was_run(experiment: Experiment, summary: Mapping[str, Any]) -> str:
    nz, ny, nx = experiment.grid.shape
    voxel, size = experiment.grid.voxel_mm, [n * experiment.grid.voxel_mm for n in (nx, ny, nz)]
    board = experiment.board
    rows = [
        ("Experiment file", f"<code>{html.escape(str(experiment.path))}</code>"),
        ("Volume", f"{size[0]:g} × {size[1]:g} × {size[2]:g} mm (x, y, z), {nx} × {ny} × {nz} voxels of {voxel:g} mm"),
        ("Time between frames", f"{experiment.dt_s:g} s: 1 voxel is {voxel / 1000 / experiment.dt_s:g} m/s"),
        (
            "Board",
            f"{board.dots[0]} × {board.dots[1]} dots, {board.spacing_mm:g} mm apart, in {len(board.planes_mm)} planes "
            f"from z = {min(board.planes_mm):g} to {max(board.planes_mm):g} mm",
        ),
        ("Image pairs", f"{len(summary['pairs'])} of {experiment.pairs}"),
        ("Computed on", html.escape(f"{summary['device']['kind']}, {summary['device']['threads']} threads")),
    ]
    body = "".join(f"<tr><td>{name}</td><td style='text-align:left'>{text}</td></tr>" for name, text in rows)
    return f'<h2>What was run</h2><div class="scroll"><table>{body}</table></div>'


def _calibration_section(experiment: Experiment, calibration: Calibration, summary: Mapping[str, Any]) -> str:
    columns = (
        ("σ_nor, held-out dots [pitch]", "sigma_nor_test", 4),
        ("dots found", "dots_found", 0),
        ("expected", "dots_expected", 0),
        ("lens array rms [px]", "lens_array_rms_px", 4),
        ("lens pitch [px]", "lens_array_pitch_px", 4),
        ("array roll [°]", "lens_array_rotation_deg", 3),
        ("network's correction, rms [pitch]", "network_correction_pitch", 4),
        ("training [s]", "training_s", 1),
    )
    reports = summary["calibration"]
    known = {key for report in reports.values() for key, value in report.items() if value is not None}
    columns = tuple(column for column in columns if column[1] in known)
    rows = [
        [name, *(_number(report.get(key), digits) for _, key, digits in columns)] for name, report in reports.items()
    ]
    parts = ["<h2>Calibration</h2>", _table(["camera", *(title for title, _, _ in columns)], rows)]
    for setup in experiment.cameras:
        camera = calibration.cameras[setup.name]
        parts.append(f"<h3>{html.escape(setup.name)}</h3>")
        parts.append(
            _figure(
                lambda setup=setup, camera=camera: figures.lens_centres(
                    experiment.white(setup.name), setup.optics, camera.lattice
                ),
                "White image with the fitted centres of the microimages. They should sit in the middle of every "
                "microimage, in the corners as in the middle.",
            )
        )
        parts.append(
            _figure(
                lambda setup=setup, camera=camera: _board_picture(experiment, setup, camera),
                "Raw board images, brightness by square root, with the outline of each dot's light as the calibrated "
                "mapping predicts it. Dots and outlines should coincide in all planes. Dashed: not measured.",
            )
        )
    parts.append("<h3>Mapping</h3>")
    errors = {setup.name: np.asarray(calibration.cameras[setup.name].test_errors) for setup in experiment.cameras}
    parts.append(
        _figure(
            lambda: figures.error_histogram(errors),
            "Mapping against the labels of dots the training did not see. Label noise is part of it: the mapping "
            "itself is usually better.",
        )
    )
    return "\n".join(parts)


def _board_picture(experiment: Experiment, setup: CameraSetup, camera: CalibratedCamera) -> bytes:
    """First, middle and last plane by depth."""
    board = experiment.board
    order = np.argsort(board.planes_mm)
    pictures, outlines, measured = {}, {}, {}
    for plane in dict.fromkeys((order[0], order[len(order) // 2], order[-1])):
        depth = board.planes_mm[plane]
        title = f"{setup.name}, z = {depth:g} mm"
        pictures[title] = experiment.board_image(setup.name, plane)
        outlines[title] = dot_outlines_px(camera.map, setup.optics, board.dots, board.spacing_mm, depth)
        numbers = plane * board.dots[0] * board.dots[1] + np.arange(board.dots[0] * board.dots[1])
        measured[title] = np.isin(numbers, camera.dots.measured_dot)
    return figures.board_dots(pictures, outlines, measured)


def dot_outlines_px(
    mapping: Callable, optics: Optics, dots: tuple[int, int], spacing_mm: float, depth_mm: float
) -> np.ndarray:
    """Outline of each dot's light on the sensor: the rays through the pupil's edge, Eq. 9.

    Returns
    -------
    ndarray, shape (dot, point, 2)
        (column, row) [pixel].
    """
    x, y = ((np.arange(n) - (n - 1) / 2) * spacing_mm for n in dots)
    points = np.array([(a, b, depth_mm) for b in y for a in x])
    angle = np.linspace(0, 2 * np.pi, RIM_POINTS, endpoint=False)
    rim = optics.pupil_radius_mm * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    on_array = mapping(np.repeat(points, RIM_POINTS, axis=0), np.tile(rim, (len(points), 1)))
    on_array = np.asarray(on_array).reshape(len(points), RIM_POINTS, 2)
    return optics.sensor_px(on_array + (on_array - rim) * optics.sensor_per_pupil)


def _volume_section(vectors: Mapping[int, Path]) -> str:
    stored = {pair: dataset.read_reconstruction(path) for pair, path in vectors.items()}
    stored = {pair: item for pair, item in stored.items() if item is not None}
    if not stored:
        return ""
    pair, first = next(iter(stored.items()))
    rows = []
    for number, item in stored.items():
        for frame, residual, stop in zip(
            item["frame"].values, item["residual"].values, item["stop"].values, strict=True
        ):
            residual = residual[np.isfinite(residual)]
            rows.append(
                [
                    f"pair {number}, {frame}",
                    _number(residual[0], 3),
                    _number(residual[-1], 3),
                    str(len(residual) - 1),
                    str(stop),
                ]
            )
    return "\n".join(
        [
            "<h2>Volumes</h2>",
            _figure(
                lambda: figures.projections(first),
                f"Brightest voxel along each axis, pair {pair}, frame {first['frame'].values[0]}. Particles should "
                "be round in x and y; along z they are longer, the more so the smaller the angle between the cameras.",
            ),
            _figure(
                lambda: figures.residual_history({f"pair {number}": item for number, item in stored.items()}),
                "What the volume's projection leaves unexplained of the images, per SMART iteration.",
            ),
            _details(
                "Residual and verdict of every volume",
                _table(["volume", "first", "last", "iterations", "verdict"], rows),
            ),
        ]
    )


def _vector_section(vectors: Mapping[int, Path], summary: Mapping[str, Any]) -> str:
    pair = next(iter(vectors))
    first = dataset.read_vectors(vectors[pair])
    rows = []
    for item in summary["pairs"]:
        nz, ny, nx = item["vectors"]
        speed = item["velocity_m_per_s"]
        spread = [f"{_number(speed[name]['mean'], 4)} ± {_number(speed[name]['sd'], 4)}" for name in ("u", "v", "w")]
        rows.append(
            [
                f"pair {item['pair']}",
                f"{nx} × {ny} × {nz}",
                _percent(item["valid_fraction"]),
                *spread,
                _number(item["uncertainty_voxel"], 3),
                _number(item["peak_ratio"], 2),
            ]
        )
    titles = ["", "vectors", "valid", "u [m/s]", "v [m/s]", "w [m/s]", "uncertainty [voxel]", "peak ratio"]
    return "\n".join(
        [
            "<h2>Vectors</h2>",
            _figure(
                lambda: figures.vector_slices(first),
                f"Pair {pair}: velocity at several depths. Arrows show u and v, colour shows w; pale arrows were "
                "replaced after validation.",
            ),
            _figure(
                lambda: figures.vector_slices(first, normal="y", most=1),
                f"Pair {pair}: the middle of the volume from the side. Arrows show u and w, colour shows v.",
            ),
            _figure(
                lambda: figures.displacement_histograms(first),
                f"Pair {pair}: displacements of the valid vectors. Peaks at whole numbers would be peak locking.",
            ),
            "<p>Mean ± standard deviation over the valid vectors; medians of uncertainty and peak ratio.</p>",
            _table(titles, rows),
        ]
    )


def _timings(summary: Mapping[str, Any]) -> str:
    names = {
        "calibration": "calibration, network training included",
        "network_training": "of it network training",
        "weights": "weights",
        "reconstruction": "reconstruction, all volumes",
        "correlation": "correlation",
        "total": "this invocation, until the report",
    }
    rows = [[text, _number(summary["timings_s"].get(key), 1)] for key, text in names.items()]
    rows.append(["peak memory [MiB]", _number(summary["peak_memory_mib"], 0)])
    kept = ""
    if summary["reused"]:
        kept = f'<p class="quiet">Kept from an earlier invocation: {html.escape(", ".join(summary["reused"]))}.</p>'
    return f"<h2>Time and memory</h2>{_table(['', 's'], rows)}{kept}"


def _small_print(summary: Mapping[str, Any]) -> str:
    settings = [
        [f"{table}.{key}", "default" if value is None else str(value)]
        for table, values in summary["settings"].items()
        for key, value in values.items()
    ]
    versions = [[name, version] for name, version in summary["versions"].items()]
    return (
        "<h2>Settings and versions</h2>"
        + _details("Settings", _table(["key", "value"], settings))
        + _details("Versions", _table(["package", "version"], versions))
    )


def _figure(draw: Callable[[], bytes], caption: str) -> str:
    """Figure that fits the page and opens at full size on a click; on narrow screens it scrolls, so text stays legible.

    A tick box that is not shown holds the state: no script, no link.
    """
    png = draw()
    width, height = (round(int.from_bytes(png[at : at + 4], "big") * CSS_DPI / figures.DPI) for at in (16, 20))
    text, image = html.escape(caption), base64.b64encode(png).decode()
    return (
        f'<figure><label class="zoom" style="--full: {ENLARGED * width:.0f}px">'
        f'<input type="checkbox" aria-label="other size"><img alt="{text}" width="{width}" height="{height}" '
        f'src="data:image/png;base64,{image}"></label><figcaption>{text}</figcaption></figure>'
    )


def _table(titles: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    head = "".join(f"<th>{html.escape(title)}</th>" for title in titles)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _details(title: str, content: str) -> str:
    return f"<details><summary>{html.escape(title)}</summary>{content}</details>"


def _number(value: float | None, digits: int) -> str:
    return "–" if value is None or not np.isfinite(value) else f"{value:.{digits}f}"


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.0f} %"


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None
