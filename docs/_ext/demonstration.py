"""Run ``lfpiv demo`` once, before the gallery is: its scripts read the results, the pages show its scene and report.

The tutorial quotes the figures of that run; see `quoted`.
"""

import importlib.resources
import json
import logging
import os
import shutil
from pathlib import Path

DOCS = Path(__file__).resolve().parents[1]
DEMO = DOCS / "gallery" / "lfpiv-demo"
EXTRA = DOCS / "generated" / "extra"


def prepare(app):
    """Run the demonstration where it is not finished, and copy its report beside the pages."""
    from lfpiv.cli import demo

    if not (DEMO / "report.html").exists():
        here = os.getcwd()
        os.chdir(DEMO.parent)  # the report names the files as a reader of the tutorial will see them
        try:
            demo.run(DEMO.name)
        finally:
            os.chdir(here)
    compare_with_the_tutorial()
    shutil.copy(DEMO / "report.html", EXTRA / "demo-report.html")


def _summary():
    """Return the run's figures, with the errors against the truth, and its scene."""
    from lfpiv.cli import demo
    from lfpiv.simulation.scene import open_scene

    with importlib.resources.as_file(importlib.resources.files("lfpiv.cli") / "demo_scene.toml") as path:
        scene = open_scene(path)
    return json.loads((DEMO / "summary.json").read_text("utf-8")) | {
        "demo": demo.compare_with_truth(scene, DEMO)
    }, scene


def compare_with_the_tutorial():
    """Warn, which ends a build with -W, where the run is no longer the one that the tutorial describes."""
    import quoted
    from sphinx.util import logging as sphinx_logging

    summary, scene = _summary()
    for text in quoted.differences(quoted.TUTORIAL.read_text("utf-8"), scene, summary):
        sphinx_logging.getLogger(__name__).warning(
            "tutorial.md quotes otherwise than the demonstration gives: %s", text
        )


def quote(app, name, source):
    """Put the figures of the run into the tutorial."""
    import quoted

    if name == quoted.TUTORIAL.stem:
        source[0] = quoted.as_built(source[0], _summary()[0])


def setup(app):
    """Copy the scene, and register the run before that of the gallery."""
    logging.getLogger("lfpiv").setLevel(logging.ERROR)  # the scripts make bad figures on purpose
    logging.getLogger("lfpiv_kernels").setLevel(logging.ERROR)
    EXTRA.mkdir(parents=True, exist_ok=True)
    scene = importlib.resources.files("lfpiv.cli") / "demo_scene.toml"
    (DOCS / "generated" / "demo_scene.toml").write_text(scene.read_text("utf-8"), "utf-8")
    app.connect("builder-inited", prepare, priority=100)
    app.connect("source-read", quote)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
