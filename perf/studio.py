"""Time from a slider's input to the new picture of `lfpiv studio`, in Chromium: ``python perf/studio.py [RESULTS]``.

RESULTS is the folder of a run; without it, a ring vortex of 100^3 vectors is made. Each slider moves in steps; a
picture counts when its pixels differ from the picture before. The server's CPU time is stated per step. Needs chromium,
chromedriver and selenium.
"""

import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import xarray as xr
from selenium import webdriver
from selenium.webdriver.chrome.service import Service

from lfpiv.geometry.grid import AXES
from lfpiv.results import netcdf
from lfpiv.simulation.flows import Ring

STEPS, LONGEST_S = 14, 120.0
VECTORS, SIZE_MM = 100, 4.0
"""Vectors along each axis of the field that is made, and its size [mm]."""
MOVE = """
const [name, values, done] = arguments, times = [], image = document.querySelector('#tab-results .lf-view img');
const canvas = Object.assign(document.createElement('canvas'), {width: 160, height: 120});
const context = canvas.getContext('2d', {willReadFrequently: true});
const look = () => { context.drawImage(image, 0, 0, 160, 120); return context.getImageData(0, 0, 160, 120).data; };
const differs = (a, b) => a.some((value, i) => Math.abs(value - b[i]) > 12);
const wait = (time) => new Promise((done) => setTimeout(done, time));
(async () => {
  for (const value of values) {
    const before = look(), start = performance.now();
    let shown = image.src;
    trame.state.set(name, value);
    while (performance.now() - start < 5000) {
      await wait(2);
      if (image.src === shown) continue;
      shown = image.src;
      await image.decode().catch(() => {});
      if (differs(before, look())) break;
    }
    times.push(performance.now() - start);
    await wait(700);
  }
  done(times);
})();
"""
"""Script that sets a value of the state again and again, and measures until the picture differs [ms]."""


def measure(driver: webdriver.Chrome, address: str, server: int) -> None:
    """Print the median and the extremes of each slider."""
    shape = {"width": 1440, "height": 900, "deviceScaleFactor": 1, "mobile": False}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", shape)
    driver.get(address)
    end = time.monotonic() + LONGEST_S
    while not driver.execute_script("return document.querySelector('#tab-results .lf-view img')?.naturalWidth > 50"):
        if time.monotonic() > end:
            raise TimeoutError("the page shows no results")
        time.sleep(0.2)
    time.sleep(2)
    plane, level = (driver.execute_script(f"return trame.state.get('{name}')") for name in ("r_box", "r_ends"))
    moved = {
        "r_z": plane[2][:2],
        "r_level": level[:2],
        "r_opacity": (0.1, 1),
        "r_length": (0.2, 6),
        "r_lines": (10, 300),
    }
    for name, (low, high) in moved.items():
        driver.execute_script(f"trame.state.set('r_arrows', {str(name == 'r_length').lower()})")
        # every other step lies in the upper half, so that each picture differs clearly
        values = [low + (high - low) * (0.3 + 0.2 * step / STEPS + 0.2 * (step % 2)) for step in range(STEPS)]
        values = [round(value) for value in values] if name == "r_lines" else values
        before = cpu_s(server)
        times = driver.execute_async_script(MOVE, name, values)
        used = 1000 * (cpu_s(server) - before) / STEPS
        print(
            f"{name}: median {statistics.median(times):.0f}, {min(times):.0f} to {max(times):.0f} ms; "
            f"CPU time of the server {used:.0f} ms"
        )


def cpu_s(process: int) -> float:
    """Return the CPU time of a process [s]."""
    user, system = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


def made(folder: Path) -> Path:
    """Write a ring vortex as the results of a run; return its folder."""
    axis = np.linspace(-SIZE_MM / 2, SIZE_MM / 2, VECTORS)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij")[::-1], axis=-1).reshape(-1, 3)
    moved = Ring(radius_mm=1.1, core_mm=0.9, peak_mm=0.3)(points).reshape(VECTORS, VECTORS, VECTORS, 3)
    fields = {name: (AXES, moved[..., k].astype(np.float32)) for k, name in enumerate("uvw")}
    fields |= {f"displacement_{name}": (AXES, 10 * moved[..., k].astype(np.float32)) for k, name in enumerate("xyz")}
    fields |= {"valid": (AXES, np.ones(moved.shape[:3], bool))}
    fields |= {name: (AXES, np.ones(moved.shape[:3], np.float32)) for name in ("peak_ratio", "uncertainty")}
    vectors = xr.Dataset(fields, {name: (name, axis, {"units": "mm"}) for name in AXES})
    for name, unit in netcdf.VECTOR_UNITS.items():
        vectors[name].attrs["units"] = unit
    vectors = vectors.assign_attrs(dt_s=1e-3, voxel_mm=[0.1] * 3)
    (folder / "vectors").mkdir()
    netcdf.write_vectors(vectors, folder / "vectors" / "pair_0000.nc", attributes={})
    return folder


def main(folder: Path) -> None:
    """Open the studio and Chromium, and measure."""
    command = [sys.executable, "-m", "lfpiv", "studio", str(folder), "--no-browser"]
    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium")
    with (
        tempfile.TemporaryDirectory() as profile,
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server,
    ):
        for option in ("--headless=new", "--no-sandbox", "--disable-gpu", f"--user-data-dir={profile}"):
            options.add_argument(option)
        driver = webdriver.Chrome(options=options, service=Service(shutil.which("chromedriver")))
        driver.set_script_timeout(LONGEST_S)
        try:
            measure(driver, server.stdout.readline().split()[1], server.pid)
        finally:
            driver.quit()
            server.terminate()


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as scratch:
        main(Path(sys.argv[1]) if len(sys.argv) > 1 else made(Path(scratch)))
