"""Sphinx settings. The build reads nothing from the network and runs the demonstration, whose pictures the pages show.

Build with ``pip install '.[docs]'`` and ``sphinx-build -W docs docs/_build/html``.
"""

import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE / "_ext"))

import lfpiv  # noqa: E402

project = "lfpiv"
author = "the lfpiv developers"
project_copyright = "the lfpiv developers, BSD-3-Clause"
version = release = lfpiv.__version__

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.viewcode",
    "sphinx.ext.githubpages",  # an empty file .nojekyll: hosts of code serve folders whose names begin with _
    "myst_parser",
    "numpydoc",
    "sphinx_gallery.gen_gallery",
    "demonstration",
    "house",
    "tables",
    "mathml",
    "side_by_side",
    "tracking_limits",
    "accuracy_plots",
    "drawings",
    "performance_plots",
    "benchmark_page",
]
exclude_patterns = ["_build", "_ext", "gallery", "generated/extra"]
nitpicky = True
nitpick_ignore_regex = [
    # Types of other packages: no inventory of theirs is read. Public names of this package must have a page.
    ("py:.*", r"(?!lfpiv).*"),
    # Inner modules and names have none; tests/test_docs.py checks that they exist.
    ("py:obj", r"lfpiv(_kernels)?\.([a-z]+|\w+(\.\w+)+)"),
]

html_theme = "furo"
html_title = f"lfpiv {version}"
html_math_renderer = "mathml"
html_static_path = ["_static"]
html_css_files = ["lfpiv.css"]
html_extra_path = ["generated/extra"]
html_show_sphinx = False

myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3
myst_dmath_allow_digits = False

default_role = "autolink"
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # numpydoc's Parameters say more
autodoc_default_options = {"exclude-members": "model_config, model_post_init"}
autosummary_generate = False
numpydoc_show_class_members = False
numpydoc_xref_param_type = False

sphinx_gallery_conf = {
    "examples_dirs": "gallery",
    "gallery_dirs": "generated/gallery",
    "filename_pattern": r"/plot_",
    "ignore_pattern": r"__init__\.py",
    "within_subsection_order": "FileNameSortKey",
    "abort_on_example_error": True,
    "download_all_examples": False,
    "remove_config_comments": True,
    "show_memory": False,
    "show_signature": False,
    "write_computation_times": False,
    "matplotlib_animations": False,
    "copyfile_regex": r".*\.toml",
}
