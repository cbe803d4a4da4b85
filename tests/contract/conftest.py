"""One small experiment, made, run, killed and resumed by the command line, and what other processes compute."""

import os
import shutil
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from contract import scene
from contract.command import WAIT_S, Run, done, edit, finish, start
from contract.stored import Stored

BITS = Path(__file__).with_name("bits.py")
SOLID = '[[volume.solid]]\nkind = "half_space"\npoint_mm = [0.0, -0.1, 0.0]\nnormal = [0.0, 1.0, 0.0]\n\n'
"""The wall of `scene.INSTANTS` as an experiment states it."""


def pytest_addoption(parser):
    parser.addoption(
        "--write-hashes", action="store_true", help="store the contract's hashes of this machine and its loops anew"
    )


@pytest.fixture(scope="session")
def loops():
    """Loops of the kernels in this process."""
    return "gpu" if "LFPIV_EMULATE_GPU" in os.environ else "cpu"


@pytest.fixture(scope="session")
def stored(request):
    return Stored(request.config.getoption("--write-hashes", default=False))


@pytest.fixture(scope="session")
def computed(tmp_path_factory):
    """Arrays of all cases of `bits.py` by one and by two threads, and by loops for a GPU."""
    folder = tmp_path_factory.mktemp("bits")
    ways = {"one thread": (1, "cpu"), "two threads": (2, "cpu"), "loops for a GPU": (1, "gpu")}
    found = {}
    for name, (cores, own) in ways.items():  # one after the other: side by side each compiles the same kernels
        finished = finish(start(BITS, folder / f"{name}.npz", cores, loops=own))
        assert finished.status == 0, finished.errors
        with np.load(folder / f"{name}.npz") as arrays:
            found[name] = {}
            for key, values in arrays.items():
                case, array = key.split("/")
                found[name].setdefault(case, {})[array] = values
    return found


@pytest.fixture(scope="session")
def killed_run(once):
    """Run on image pairs with tracked particles. An invocation before is killed after its first pair."""
    return once("contract-pairs", killed_and_resumed)


def killed_and_resumed(folder):
    experiment = scene.simulate(done, folder, scene.PAIRS)
    out, first = folder / "out", folder / "out" / "vectors" / "pair_0000.nc"
    killed = start("-m", "lfpiv", "run", experiment, "--out", out, "--keep-volumes", start_new_session=True)
    deadline = time.monotonic() + WAIT_S
    while not first.exists() and killed.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    os.killpg(killed.pid, signal.SIGKILL)
    status, early = finish(killed).status, first.read_bytes()
    done("run", experiment, "--out", out, "--keep-volumes")
    return Run(experiment, out, status, early)


@pytest.fixture(scope="session")
def series(tmp_path_factory, killed_run):
    """Run on a time series beside a wall, with tracks, calibrated as `killed_run`."""
    folder = tmp_path_factory.mktemp("series")
    experiment = scene.simulate(done, folder, scene.INSTANTS)
    edit(experiment, "[smart]", SOLID + "[smart]\nrefinement = 1.0")
    for part in ("white", "board"):  # the same pixels, and the times of the files that were calibrated
        shutil.copytree(killed_run.experiment.parent / part, experiment.parent / part, dirs_exist_ok=True)
    (folder / "out").mkdir()
    shutil.copy2(killed_run.out / "calibration.h5", folder / "out")
    done("run", experiment, "--out", folder / "out")
    return Run(experiment, folder / "out")
