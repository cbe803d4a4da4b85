"""Images are read and results written beside the computation: same results, errors where they belong."""

import shutil
import threading

import numpy as np
import pytest
from support.small_run import PAIRS, damage, same_vectors

from lfpiv.errors import InputError, StorageError
from lfpiv.experiment.experiment import Experiment
from lfpiv.experiment.opening import open_experiment
from lfpiv.results.pair_files import PairFiles
from lfpiv.runs import pipeline
from lfpiv.runs.side_threads import ReadAhead, Writer

READER, WRITER = "lfpiv images", "lfpiv results"


@pytest.fixture
def readers(monkeypatch):
    """Record (frame, thread) of each particle image that is read."""
    found, inner = [], Experiment.frame_image

    def read(self, name, frame):
        found.append((frame, threading.current_thread().name))
        return inner(self, name, frame)

    monkeypatch.setattr(Experiment, "frame_image", read)
    return found


def test_images_that_come_are_read_by_a_thread_once_and_forgotten(tiny_experiment, readers):
    experiment = open_experiment(tiny_experiment)
    expected = {name: experiment.particle_image(name, 1, "a") for name in ("left", "right")}
    readers.clear()
    images, (_, other), (frame, second) = ReadAhead(experiment), *map(experiment.pair_frames, (0, 1))
    images.start([frame, other])
    for name, image in expected.items():
        np.testing.assert_array_equal(images.image(name, frame), image)
    assert all(thread == READER for *_, thread in readers)
    images.start([second], present=[frame])
    images.image("left", other)  # it was forgotten
    images.image("left", frame)  # it was taken
    assert {one for one, thread in readers if thread != READER} == {other, frame}


def test_an_image_that_cannot_be_read_fails_when_it_is_taken(tiny_experiment):
    experiment = open_experiment(tiny_experiment)
    experiment.particle_path("right", 1, "b").unlink()
    images, (first, second) = ReadAhead(experiment), experiment.pair_frames(1)
    images.start([first, second])
    assert images.image("left", first).ndim == images.image("right", first).ndim == 2
    with pytest.raises(InputError, match="no such file"):
        images.image("right", second)


def test_results_are_written_in_order_and_errors_belong_to_their_result():
    writer, written, go = Writer(), [], threading.Event()

    def fail():
        raise StorageError("the disk is full")

    first = writer.start(lambda: go.wait(10) and written.append(1), large=True)
    second, third = writer.start(fail, large=True), writer.start(lambda: written.append(3))
    assert written == [] and not first.done()
    go.set()
    writer.wait_large()
    assert first.done() and second.done() and first.exception() is None
    writer.wait()
    assert written == [1, 3] and third.exception() is None
    with pytest.raises(StorageError, match="the disk is full"):
        second.result()


@pytest.mark.slow
def test_a_run_reads_ahead_and_writes_behind_with_the_same_results(coarse_run, tmp_path, readers, monkeypatch):
    out = coarse_run.results(tmp_path / "out")
    shutil.rmtree(out / "vectors")
    shutil.rmtree(out / "volumes")
    writers, inner = set(), PairFiles.write_vectors
    monkeypatch.setattr(
        PairFiles, "write_vectors", lambda *args: writers.add(threading.current_thread().name) or inner(*args)
    )
    summary = pipeline.run(coarse_run.experiment, out, keep_volumes=True)
    assert summary["failed"] == [] and same_vectors(coarse_run.out, out) == PAIRS
    assert {frame.number // 2 for frame, thread in readers if thread == READER} == set(range(1, PAIRS))
    assert writers == {WRITER}
    assert len(list((out / "volumes").iterdir())) == 2 * PAIRS


@pytest.mark.slow
def test_a_damaged_image_fails_its_pair_and_a_full_disk_the_run_at_its_pair(coarse_run, tmp_path, monkeypatch):
    file, out = coarse_run.images(tmp_path / "data"), coarse_run.calibrated(tmp_path / "out")
    damage(sorted((file.parent / "particles").rglob("*0002*"))[0])
    inner = PairFiles.write_vectors

    def full(self, *arguments):
        if self.pair == 3:
            raise OSError(28, "No space left on device")
        inner(self, *arguments)

    monkeypatch.setattr(PairFiles, "write_vectors", full)
    summary = pipeline.run(file, out)
    assert [entry["pair"] for entry in summary["failed"]] == [2, 3]
    assert [entry["pair"] for entry in summary["pairs"]] == [0, 1]

    def storage(self, *arguments):
        raise StorageError(f"{self.vectors}: cannot be written")

    monkeypatch.setattr(PairFiles, "write_vectors", storage)
    with pytest.raises(StorageError, match=r"pair_0003\.nc"):
        pipeline.run(file, out, pairs=(3, None))
    assert not list(out.rglob("*.tmp")) and not (out / "vectors" / "pair_0003.nc").exists()
