"""A time series made of the images of `small_run`, and the work on it without the steps before."""

import dataclasses
import shutil
from pathlib import Path

import h5py
from distributed import KilledWorker

from lfpiv.experiment.opening import read_experiment
from lfpiv.experiment.recording import Recording
from lfpiv.results.folder import Folder
from lfpiv.results.stamps import Inputs
from lfpiv.runs import dispatch, guard, refinement
from lfpiv.runs.pair import PairWork
from lfpiv.runs.work_units import cut
from lfpiv.runs.worker import Result
from lfpiv.weights.operator import build_weights

FIRST = 3
"""Number of the first instant."""


def write_series(small_run, folder: Path) -> Path:
    """Write the images of the small run's pairs one after the other as instants; return the experiment file.

    Instants 3 and 4 are the frames of pair 0, 5 and 6 those of pair 1. Between pairs the particles are others.
    Voxels are no finer than those of the vectors, and iterations are few: half of the time.
    """
    file = small_run.images(folder)
    pairs = read_experiment(file)
    for pair in pairs.numbers:
        for number, frame in enumerate(pairs.frames):
            for camera in pairs.cameras:
                path = folder / f"run/{camera.name}/{FIRST + 2 * pair + number:05d}.tif"
                path.parent.mkdir(parents=True, exist_ok=True)
                pairs.particle_path(camera.name, pair, frame).rename(path)
    text = file.read_text().replace("iterations = 8", "iterations = 3\nrefinement = 1.0")
    head, particles = text.split("[particles]\n")
    rest = particles.split("\n\n", 1)[1]
    keys = f'images = "run/{{camera}}/{{instant:05d}}.tif"\ninstants = {2 * pairs.pairs}\nfirst = {FIRST}\n\n'
    file.write_text(f"{head}[particles]\n{keys}{rest}")
    return file


def make_work(small_run, file: Path, out: Path) -> PairWork:
    """Return the work on all pairs of a series, with the calibration, guard layers and refinement of the small run."""
    from lfpiv.calibration.camera import load_calibration

    out.mkdir()
    shutil.copy2(small_run.out / "calibration.h5", out)
    experiment = read_experiment(file)
    (measured, _), (sized, _) = guard.read(Folder(small_run.out)), refinement.read(Folder(small_run.out))
    layers, finer = guard.layers(experiment, measured), refinement.factor(experiment, sized)
    calibration = load_calibration(out / "calibration.h5")
    with h5py.File(out / "calibration.h5") as stored:
        stamp = stored.attrs["settings_hash"]
    return PairWork(
        experiment=experiment,
        folder=Folder(out, experiment.recording),
        inputs=Inputs(stamp, guard=layers, refinement=finer),
        weights=build_weights(calibration, experiment.grid.padded(layers).refined(finer)),
        cameras=calibration.cameras,
        keep_volumes=False,
    )


def changed(work: PairWork, out: Path, *, step: int = 1, instants: int = 6, **settings) -> PairWork:
    """Return the work on the first instants, with another step or output folder."""
    recording = Recording.of_series(instants, work.experiment.recording.first, step)
    experiment = dataclasses.replace(work.experiment, recording=recording)
    return dataclasses.replace(work, experiment=experiment, folder=Folder(out, recording), **settings)


def chained(pairs, step: int) -> list[int]:
    """Return pairs in the order k, k + step, k + 2 step, ..."""
    return sorted(pairs, key=lambda pair: (pair % step, pair))


class Processes:
    """A client of Dask whose workers do their work units at once, in this process; `deaths` tells when one dies.

    `deaths` maps the first pair of a work unit to a list: after how many pairs a worker dies of it, at each trial.
    """

    def __init__(self, work: PairWork, deaths=None):
        self.work, self.deaths, self.submitted = work, {key: list(value) for key, value in (deaths or {}).items()}, []

    def submit(self, function, shared, unit, topic, name, *, key, pure, **options):
        self.submitted.append(unit)
        deaths = self.deaths.get(unit.pairs[0], [])
        left, outcomes = deaths.pop(0) if deaths else None, []
        for outcome in self.work.do(unit.pairs, lambda number, fraction: None, stored=unit.stored):
            outcomes.append(outcome)
            if len(outcomes) == left:
                return Done(key, "error", None)
        return Done(key, "finished", Result(outcomes=tuple(outcomes)))

    def subscribe_topic(self, topic, handler):
        pass

    def unsubscribe_topic(self, topic):
        pass


class Done:
    """A future that is done."""

    def __init__(self, key, status, result):
        self.key, self.status, self.found = key, status, result

    def result(self, timeout):
        return self.found

    def exception(self):
        return KilledWorker(self.key, None, 0)

    def add_done_callback(self, call):
        call(self)


def in_processes(work: PairWork, workers: int, deaths=None):
    """Do all pairs in work units for several workers; return their outcomes by pair, and the client."""
    client = Processes(work, deaths)
    todo = chained(work.experiment.numbers, work.experiment.recording.step)
    units = cut(todo, work.experiment.recording.step, workers)
    found = dispatch.Dispatch(client, lambda: workers, Path("shared"), units, len(todo), "instant")
    return {outcome.pair: outcome for outcome in found.outcomes(lambda fraction: None)}, client
