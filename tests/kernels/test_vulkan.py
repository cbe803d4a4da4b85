"""Taichi's kernels on Vulkan against those on the CPU. Each needs a process of its own."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
ROUNDING = 1e-6
"""Of single precision, relative to the largest value: some ten operations, and library functions of another driver."""
MOVED = 1e-3
"""Share of the light on other pixels or under other lenses: rays within single precision of an edge."""


def computed(file, arch):
    """Compute the results of all kernels in a process of its own. Skip the test without a driver of Vulkan."""
    paths = [str(ROOT), str(ROOT / "tests"), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "LFPIV_TAICHI": arch, "PYTHONPATH": os.pathsep.join(paths)}
    command = [sys.executable, str(ROOT / "tests" / "support" / "taichi_kernels.py"), str(file)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    if "finds no driver" in done.stderr:
        if os.environ.get("LFPIV_REQUIRE_VULKAN") == "1":
            pytest.fail(done.stderr)
        pytest.skip("no driver of Vulkan; Debian: mesa-vulkan-drivers")
    assert done.returncode == 0, done.stderr
    return np.load(file)


@pytest.mark.slow
def test_results_on_vulkan_are_those_of_the_processor(tmp_path):
    vulkan, processor = computed(tmp_path / "vulkan.npz", "vulkan"), computed(tmp_path / "cpu.npz", "")
    assert set(vulkan) == set(processor) and len(processor.files) == 15
    np.testing.assert_allclose(
        vulkan["rays"], processor["rays"], rtol=0, atol=ROUNDING * np.abs(processor["rays"]).max()
    )
    for name in sorted({*processor.files} - {"rays"}):
        light = processor[name].sum()
        assert light > 10 * processor[name].max() > 0, name
        assert np.abs(vulkan[name] - processor[name]).sum() <= MOVED * light, name
