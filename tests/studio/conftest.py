"""Tests of the studio need its extra."""

import importlib.util
import os

import pytest

NEEDED = ("trame", "trame_vtk", "trame_vuetify", "pyvista", "tomlkit", "imageio_ffmpeg", "psutil")


@pytest.fixture(scope="session", autouse=True)
def extra():
    """Skip tests of the studio without its extra, or fail where it is required."""
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        message = f"the extra `studio` is not installed: {', '.join(missing)}"
        if os.environ.get("LFPIV_REQUIRE_STUDIO") == "1":
            pytest.fail(message)
        pytest.skip(message)
