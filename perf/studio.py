"""Time from a slider's input to the new picture of `lfpiv studio`, in Chromium: ``python perf/studio.py RESULTS``.

RESULTS is the folder of a run. Each slider moves in steps; a picture counts when its pixels differ from the picture
before. Needs chromium, chromedriver and selenium.
"""

import shutil
import statistics
import subprocess
import sys
import tempfile
import time

from selenium import webdriver
from selenium.webdriver.chrome.service import Service

STEPS, LONGEST_S = 14, 60.0
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


def measure(driver: webdriver.Chrome, address: str) -> None:
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
    for name, (low, high) in {"r_z": plane[2][:2], "r_level": level[:2], "r_opacity": (0.1, 1)}.items():
        values = [low + (high - low) * (0.3 + 0.4 * step / STEPS) for step in range(STEPS)]
        times = driver.execute_async_script(MOVE, name, values)
        print(f"{name}: median {statistics.median(times):.0f}, {min(times):.0f} to {max(times):.0f} ms")


def main(folder: str) -> None:
    """Open the studio and Chromium, and measure."""
    command = [sys.executable, "-m", "lfpiv", "studio", folder, "--no-browser"]
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
            measure(driver, server.stdout.readline().split()[1])
        finally:
            driver.quit()
            server.terminate()


if __name__ == "__main__":
    main(sys.argv[1])
