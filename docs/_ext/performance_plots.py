"""Plots and a table of the page on performance, drawn from stored figures in the colours of the page, light or dark.

`draw`, `table` and `gpu_table` need no Sphinx; `setup` registers the directives ``{performance-plot} NAME ...`` and
``{performance-table}``, ``{gpu-table}``. `perf/scaling.py`, `perf/run.py` and `perf/gpu_static.py` write the figures.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from panels import add_directive

from lfpiv.report import svg

FOLDER = Path(__file__).resolve().parents[1] / "figures"
SCALING, PEERS = FOLDER / "scaling.json", FOLDER / "peers.jsonl"
GPU_STATIC = FOLDER / "gpu_static.json"
PARTS = {
    "weights_s": "weights, once",
    "volumes_s": "both volumes",
    "vectors_s": "vectors",
    "joint_s": "joint fit",
}
PEER_NAMES = {
    "project_small": "projection, SciPy CSR",
    "back_project_small": "back projection, SciPy CSR",
    "smart_small": "SMART, SciPy CSR",
    "deform_medium": "deformation, SciPy splines",
    "correlate_8_medium": "correlation 8³, OpenPIV",
    "correlate_16_medium": "correlation 16³, OpenPIV",
    "train_small": "training, SciPy least squares",
}
"""What a case of `perf/run.py` does, and whose work it is compared with."""

Rows = Sequence[Mapping[str, Any]]


def scaling_rows() -> Rows:
    """Return time and memory by size and cameras."""
    rows: Rows = json.loads(SCALING.read_text("utf-8"))["rows"]
    return rows


def peer_rows() -> Rows:
    """Return how many times as fast as its peer each case is, with the range of the turns."""
    lines = [json.loads(line) for line in PEERS.read_text("utf-8").splitlines()]
    return [line for line in lines if line.get("metric") == "faster_than_peer"]


def scaling(axes: Axes) -> str:
    """Draw the times of a pair against the number of voxels, of two cameras."""
    rows = [row for row in scaling_rows() if row["cameras"] == 2]
    voxels = [row["voxels"] ** 3 for row in rows]
    for (key, label), colour in zip(PARTS.items(), svg.SERIES, strict=False):
        axes.loglog(voxels, [row[key] for row in rows], "o-", color=colour, lw=1.6, ms=3.5, label=label)
    axes.set_xticks(voxels, [f"{row['voxels']}³" for row in rows])
    axes.set_xticks([], minor=True)
    axes.tick_params(which="minor", colors=svg.INK)
    svg.style(axes, title="time of a pair, two cameras", xlabel="voxels", ylabel="wall time [s]", legend=True)
    return "Time of weights, volumes and vectors against the number of voxels"


def peers(axes: Axes) -> str:
    """Draw how many times as fast as its peer each kernel is."""
    rows = peer_rows()
    place, values = range(len(rows)), [row["value"] for row in rows]
    spread = [[abs(row["value"] - row["turns"][side]) for row in rows] for side in (0, 1)]
    axes.barh(place, values, xerr=spread, height=0.6, color=svg.SERIES[0], ecolor=svg.INK)
    axes.set_xscale("log")
    axes.set_xlim(1, 2.2 * max(values))
    axes.set_xticks([1, 2, 5, 10, 20, 50], ["1", "2", "5", "10", "20", "50"])
    axes.set_xticks([], minor=True)
    axes.set_yticks(place, [PEER_NAMES[row["case"]] for row in rows])
    axes.invert_yaxis()
    svg.style(axes, title="times as fast as its peer", xlabel="ratio of wall times, in turns")
    return "How many times as fast as other software each kernel is"


PLOTS = {"scaling": scaling, "peers": peers}
"""Plots by name."""


def draw(name: str) -> str:
    """Return one of `PLOTS` as SVG."""
    figure, axes = svg.new_panel(2.8)
    alt = PLOTS[name](axes)
    return svg.to_svg(figure, alt)


def table() -> str:
    """Return time and memory by size and cameras as Markdown."""
    lines = [
        f"| volume | cameras | {' | '.join(PARTS.values())} | weights in memory | peak memory |",
        f"|{'---|' * (len(PARTS) + 4)}",
    ]
    for row in scaling_rows():
        times = " | ".join("" if row[key] is None else f"{row[key]:.2g} s" for key in PARTS)
        lines.append(
            f"| {row['voxels']}³ voxels | {row['cameras']} | {times} | {row['weights_gib']:.2g} GiB | "
            f"{row['peak_gib']:.2g} GiB |"
        )
    return "\n".join(lines)


def gpu_table() -> str:
    """Return registers, stack, spills and occupancy of the kernels on GPUs as Markdown, the fullest kernels first."""
    rows: Rows = json.loads(GPU_STATIC.read_text("utf-8"))
    kernels: dict[tuple[str, str], dict[int, Mapping[str, Any]]] = {}
    for row in rows:
        kernels.setdefault((row["module"], row["name"]), {})[row["architecture"]] = row
    capabilities = sorted({row["architecture"] for row in rows})
    named = ", ".join(f"{one / 10:.1f}" for one in capabilities)
    lines = [
        f"| kernel | registers at {named} | stack [byte] | spilled [byte] | occupancy at {named} |",
        "|---|---|---|---|---|",
    ]
    for (module, name), found in sorted(
        kernels.items(), key=lambda item: (min(row["occupancy"] for row in item[1].values()), item[0])
    ):
        by = [found[one] for one in capabilities]
        registers, occupancy = (", ".join(format(row[key]) for row in by) for key in ("registers", "occupancy"))
        stack, spilled = (max(row[key] for row in by) for key in ("stack", "spilled"))
        lines.append(f"| `{module}.{name}` | {registers} | {stack} | {spilled} | {occupancy} |")
    return "\n".join(lines)


def setup(app):
    """Register the directives."""
    from sphinx.util.docutils import SphinxDirective

    class PerformanceTable(SphinxDirective):
        """Time and memory."""

        def run(self):
            self.env.note_dependency(str(SCALING))
            return self.parse_text_to_nodes(table())

    class GpuTable(SphinxDirective):
        """What the CUDA compiler makes of the kernels."""

        def run(self):
            self.env.note_dependency(str(GPU_STATIC))
            return self.parse_text_to_nodes(gpu_table())

    app.add_directive("performance-table", PerformanceTable)
    app.add_directive("gpu-table", GpuTable)
    return add_directive(app, "performance-plot", draw, PLOTS, (SCALING, PEERS))
