"""Shared fixtures: the kernels' device, the sample data beside the checkout, and a browser."""

import importlib.util
import os
import pickle
import shutil
from functools import partial
from pathlib import Path

import pytest
from hypothesis import settings
from threadpoolctl import threadpool_limits

try:
    import fcntl
except ImportError:  # no POSIX: each test process makes its own
    fcntl = None

# Tests see the same examples each time. Others: pytest --hypothesis-profile=search --hypothesis-seed=1
settings.register_profile("suite", derandomize=True, database=None, deadline=None, max_examples=100)
settings.register_profile("search", database=None, deadline=None, max_examples=5000)
settings.load_profile("suite")

SHARED_RUNS = {"small_run", "coarse_run", "reported", "killed_run"}
"""Fixtures that several files use; the first process that needs such a run makes it, and the others wait for it."""

SAMPLE_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


def pytest_addoption(parser):
    parser.addoption(
        "--device",
        choices=("cpu", "cuda"),
        default="cpu",
        help="device on which kernel tests run; cuda never falls back to the CPU",
    )
    parser.addoption(
        "--emulate-gpu",
        action="store_true",
        help="run the kernels' loops for a GPU on the CPU, one thread after the other",
    )
    parser.addoption(
        "--all", action="store_true", help="run the slow tests as well, as the continuous integration does"
    )
    parser.addoption(
        "--taichi",
        choices=("vulkan",),
        help="run Taichi's kernels by a driver of Vulkan, for example the software driver lavapipe of Mesa",
    )


def pytest_configure(config):
    """Choose cores and the kernels' loops before any test imports NumPy, whose BLAS counts the cores, and kernels."""
    if (name := os.environ.get("PYTEST_XDIST_WORKER")) and hasattr(os, "sched_setaffinity"):
        workers = int(os.environ["PYTEST_XDIST_WORKER_COUNT"])
        own = share_of_cores(int(name.removeprefix("gw")), workers)
        os.sched_setaffinity(0, own)
        threadpool_limits(len(own))  # of a BLAS that counted the cores before
    if config.getoption("--emulate-gpu"):
        os.environ["LFPIV_EMULATE_GPU"] = "1"
    if arch := config.getoption("--taichi"):
        os.environ["LFPIV_TAICHI"] = arch


def pytest_collection_modifyitems(config, items):
    """Leave out slow tests, unless all are asked for, or some by `-m` or by their names; put files in order."""
    asked = config.getoption("--all") or config.option.markexpr or any("::" in name for name in config.args)
    slow = {item for item in items if is_slow(item)}
    if not asked:
        config.hook.pytest_deselected(items=slow)
    items[:] = in_order_of_files([item for item in items if asked or item not in slow], slow)


def in_order_of_files(items, slow):
    """Return the tests file by file such that two processes neither wait for each other nor end far apart.

    A file for each run that processes share comes first, so that it is made while other processes have other work. Then
    files with many slow tests come before others, and files that read a shared run come last.
    """
    files = {}
    for item in items:
        files.setdefault(item.path, []).append(item)
    reads = {
        path: {run for run in SHARED_RUNS for item in tests if run in item.fixturenames}
        for path, tests in files.items()
    }
    ordered = sorted(files, key=lambda path: (bool(reads[path]), -len(slow.intersection(files[path]))))
    makers = {run: next((path for path in reversed(ordered) if run in reads[path]), None) for run in SHARED_RUNS}
    ordered.sort(key=lambda path: path not in makers.values())
    return [item for path in ordered for item in files[path]]


def is_slow(item):
    """Whether a test has the marker `slow`; its parameters named in `but` are quick."""
    return any(marker.kwargs.get("but", "::") not in item.name for marker in item.iter_markers("slow"))


def share_of_cores(worker, workers):
    """Return the cores of one of several test processes; each has its own as long as there are enough."""
    cores = sorted(os.sched_getaffinity(0))
    return set(cores[worker::workers]) or {cores[worker % len(cores)]}


def made_once(tmp_path_factory, name, make):
    """Return `make(folder)`; of several test processes the first one makes it, the others read what it returned."""
    if "PYTEST_XDIST_WORKER" not in os.environ or fcntl is None:
        return make(tmp_path_factory.mktemp(name))
    folder = tmp_path_factory.getbasetemp().parent / name  # beside the folders of the processes
    with folder.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        stored = folder.with_suffix(".pickle")
        if not stored.exists():
            shutil.rmtree(folder, ignore_errors=True)  # of a process that failed
            folder.mkdir()
            stored.write_bytes(pickle.dumps(make(folder)))
        return pickle.loads(stored.read_bytes())


@pytest.fixture(scope="session")
def once(tmp_path_factory):
    """Return `made_once` in the folders of these tests."""
    return partial(made_once, tmp_path_factory)


@pytest.fixture(scope="session", autouse=True)
def device(request):
    """Start the kernel device once, before any test can choose another."""
    from lfpiv_kernels import runtime

    return runtime.start(request.config.getoption("--device"))


@pytest.fixture(scope="session", autouse=True)
def few_counted_voxels():
    """Hold integrated weights against counted rays in two voxels per camera; return how many users have.

    The count takes half of a small run. By a single voxel other forms are chosen than users get.
    `tests/weights`, and tests with `whole_count`, compare all voxels.
    """
    from lfpiv.weights import counting

    whole = counting.VOXELS
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(counting, "VOXELS", 2)
        yield whole


@pytest.fixture
def whole_count(few_counted_voxels, monkeypatch):
    """Compare as many voxels with counted rays as users do."""
    monkeypatch.setattr("lfpiv.weights.counting.VOXELS", few_counted_voxels)


@pytest.fixture(scope="session")
def small_run(tmp_path_factory, device):
    """Return a small simulated experiment, run from images to vectors; see `small_run.SmallRun`."""
    from support.small_run import make_small_run

    return made_once(tmp_path_factory, "small", lambda folder: make_small_run(folder, device.kind))


@pytest.fixture(scope="session")
def coarse_run(small_run, tmp_path_factory, device):
    """Return the small run with coarser voxels, whose pairs take half the time, for tests of files and processes."""
    from support.small_run import make_coarse_run

    return made_once(tmp_path_factory, "coarse", lambda folder: make_coarse_run(small_run, folder, device.kind))


@pytest.fixture
def brief_run(monkeypatch):
    """Run without report, comparison of cameras and odd pairs."""
    from support.small_run import leave_out

    leave_out(monkeypatch.setattr)


@pytest.fixture
def empty_report(monkeypatch):
    """Write an empty page in place of the report of a run."""
    from support.small_run import write_empty_report

    monkeypatch.setattr("lfpiv.report.page.write_report", write_empty_report)


@pytest.fixture(scope="session")
def reported(tmp_path_factory, device):
    """Return a small finished run, and its report under `page`."""
    from support.report_run import make_run

    return made_once(tmp_path_factory, "reported", make_run)


@pytest.fixture(scope="session")
def sample_data():
    """Return the folder of the sample data. Skip the test where it is missing, or fail if it is required."""
    if SAMPLE_DATA.is_dir():
        return SAMPLE_DATA
    message = f"the sample data folder {os.path.relpath(SAMPLE_DATA, SAMPLE_DATA.parents[1])} is not there"
    if os.environ.get("LFPIV_REQUIRE_SAMPLE_DATA") == "1":
        pytest.fail(message)
    pytest.skip(message)


CHROMIUM_OPTIONS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)
"""Options of Chromium: no network, no profile, WebGL in software."""


@pytest.fixture(scope="session")
def browser(tmp_path_factory):
    """Start headless Chromium with WebGL. Skip the test where it is missing, or fail if it is required."""
    missing = [name for name in ("chromium", "chromedriver") if shutil.which(name) is None]
    missing += ["selenium"] if importlib.util.find_spec("selenium") is None else []
    if missing:
        message = f"no browser: {', '.join(missing)} not installed"
        if os.environ.get("LFPIV_REQUIRE_BROWSER") == "1":
            pytest.fail(message)
        pytest.skip(message)
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium")
    for option in (*CHROMIUM_OPTIONS, f"--user-data-dir={tmp_path_factory.mktemp('chromium')}"):
        options.add_argument(option)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(shutil.which("chromedriver")))
    yield driver
    driver.quit()


TINY_EXPERIMENT = """
name = "tiny"
dt_s = 1e-3

[[camera]]
name = "left"
white_image = "white/left.tif"
focal_length_mm = 100.0
magnification = -1.0
f_number = 4.0
microlens_pitch_mm = 0.1
microlens_focal_length_mm = 0.8
pixel_um = 10.0
nominal_angle_deg = 30.0

[[camera]]
name = "right"
white_image = "white/right.tif"
dark_image = "dark/right.tif"
focal_length_mm = 100.0
magnification = -1.0
f_number = 4.0
microlens_pitch_mm = 0.1
microlens_focal_length_mm = 0.8
pixel_um = 10.0
nominal_angle_deg = -30.0

[board]
dots = [5, 5]
spacing_mm = 0.1
dot_diameter_mm = 0.02
planes_mm = [-0.2, 0.2]
images = "board/{camera}/plane_{plane:02d}.tif"

[volume]
centre_mm = [0.0, 0.0, 0.1]
size_mm = [0.8, 0.6, 0.4]
voxel_mm = 0.05

[particles]
images = "particles/{camera}/{pair:04d}{frame}.tif"
pairs = 2
"""


@pytest.fixture
def tiny_experiment(tmp_path):
    """Write an experiment whose images are small random arrays: valid files without physics."""
    import numpy as np
    import tifffile

    folder = tmp_path / "tiny"
    rng = np.random.default_rng(0)
    shapes = {"left": (48, 64), "right": (56, 40)}
    for camera, shape in shapes.items():
        names = [f"white/{camera}", *(f"board/{camera}/plane_{plane:02d}" for plane in range(2))]
        names += [f"particles/{camera}/{pair:04d}{frame}" for pair in range(2) for frame in "ab"]
        names += ["dark/right"] if camera == "right" else []
        for name in names:
            path = folder / f"{name}.tif"
            path.parent.mkdir(parents=True, exist_ok=True)
            counts = rng.integers(0, 20 if name.startswith("dark") else 4096, shape, dtype=np.uint16)
            tifffile.imwrite(path, counts, compression="zlib")
    file = folder / "experiment.toml"
    file.write_text(TINY_EXPERIMENT, "utf-8")
    return file
