"""Take the pictures of the studio that the pages show: ``python docs/_ext/studio_pictures.py FOLDER``.

FOLDER holds an experiment and its finished results, as `lfpiv demo` writes them. A run into a folder "again" beside
FOLDER is begun anew. Each tab is seen by headless Chromium, 1440 pixels wide in light and dark, and 390 pixels
wide in light.
"""

import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from selenium import webdriver
from selenium.webdriver.chrome.service import Service

OUT = Path(__file__).resolve().parents[1] / "_static" / "studio"
SIZES = {"wide": (1440, 900), "narrow": (390, 844)}
TABS = {
    "images": ("i_plane", {"i_name": "plane 2"}),
    "experiment": ("x_tables", {"x_shown": [1]}),
    "space": ("s_facts", {"s_seen": True}),
    "preview": ("t_voxels", {}),
    "runs": ("p_status", {"p_out": "again"}),
    "results": ("r_chart", {"r_arrows": True}),
}
"""Name of a tab -> a value of the state that is there when it is drawn, and values that are set for the picture."""
CLICKED = {"preview": ("t-try", "t_after", 0), "runs": ("p-start", "p_stages", 2)}
"""Name of a tab -> a button that is clicked at first, a value of the state, and the length that it passes."""
LONGEST_S, TAKEN_S, SETTLED_S = 400.0, 1.0, 4.0
"""Longest time until a tab is drawn, time until values are taken, and time until its picture is taken [s]."""


def take(folder: str) -> None:
    """Take all pictures."""
    command = [sys.executable, "-m", "lfpiv", "studio", folder, "--no-browser"]
    OUT.mkdir(parents=True, exist_ok=True)
    for earlier in Path(folder).resolve().parent.glob("again/.run.log"):
        shutil.rmtree(earlier.parent)
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            address = server.stdout.readline().split()[1]
            with tempfile.TemporaryDirectory() as profile:
                options = webdriver.ChromeOptions()
                options.binary_location = shutil.which("chromium")
                for option in ("--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"):
                    options.add_argument(option)
                options.add_argument(f"--user-data-dir={profile}")
                driver = webdriver.Chrome(options=options, service=Service(shutil.which("chromedriver")))
                try:
                    see(driver, address)
                finally:
                    driver.quit()
        finally:
            server.terminate()


def see(driver: webdriver.Chrome, address: str) -> None:
    """Open each tab at each size and write what is seen."""
    for size, (width, height) in SIZES.items():
        shape = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": size == "narrow"}
        driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", shape)
        driver.get(address)
        wait(driver, "return !!(window.trame && trame.state && trame.state.get('tab'))")
        for tab, (ready, values) in TABS.items():
            for theme in ("light", "dark") if size == "wide" else ("light",):
                opened = f"trame.state.set('theme', '{theme}'); trame.state.set('tab', '{tab}')"
                wait(driver, f"{opened}; const v = trame.state.get('{ready}'); return !!v && v.length !== 0")
                for name, value in values.items():
                    driver.execute_script("trame.state.set(arguments[0], arguments[1])", name, value)
                time.sleep(TAKEN_S)
                button, shown, parts = CLICKED.get(tab, ("", "", 0))
                if button and not driver.execute_script(f"return (trame.state.get('{shown}') || []).length"):
                    click(driver, button)
                    wait(driver, f"return trame.state.get('{shown}').length > {parts}")
                    if tab == "preview":  # and once more, changed
                        driver.execute_script("trame.state.set('t_correlation_overlap', 0.5)")
                        click(driver, button)
                        wait(driver, "return !!trame.state.get('t_before')")
                time.sleep(SETTLED_S)
                driver.save_screenshot(str(OUT / f"{tab}_{size}_{theme}.png"))


def click(driver: webdriver.Chrome, button: str) -> None:
    """Click a button as soon as it can be clicked."""
    wait(driver, f"const b = document.getElementById('{button}'); return !!b && b.offsetParent && !b.disabled")
    driver.find_element("id", button).click()


def wait(driver: webdriver.Chrome, script: str) -> None:
    """Wait until a script returns true."""
    end = time.monotonic() + LONGEST_S
    while not driver.execute_script(script):
        if time.monotonic() > end:
            raise TimeoutError(script)
        time.sleep(0.2)


if __name__ == "__main__":
    take(sys.argv[1])
