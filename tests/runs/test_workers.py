"""Pairs side by side: plans, weights that processes share, the same numbers from one worker, several, or a cluster."""

import logging
import os
import subprocess
import sys
import time
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import psutil
import pytest
from distributed import Client, Security
from support.ideal_rig import two_cameras
from support.series_run import Done
from support.small_run import PAIRS
from support.stored import rewrite

import lfpiv
from lfpiv.cli import commands
from lfpiv.errors import ClusterError, InputError, StorageError
from lfpiv.experiment.opening import read_experiment
from lfpiv.geometry.grid import Grid
from lfpiv.results import datasets, netcdf, provenance, stamps
from lfpiv.results.stamps import Inputs
from lfpiv.runs import cluster_workers, dispatch, guard, local_workers, memory, pipeline, worker_plan
from lfpiv.runs.pair_outcome import Outcome
from lfpiv.runs.work_units import cut
from lfpiv.runs.worker import Result
from lfpiv.weights import storage
from lfpiv_kernels.runtime import Device

ROOT = Path(__file__).resolve().parents[2]


CPU, GPU = Device("cpu", 8), Device("cuda", 8)


FOUR = ("0", "1", "2", "3")


def test_dask_logs_no_traceback_of_a_broken_connection():
    local_workers.import_distributed("--scheduler")
    assert not logging.getLogger("distributed.batched").isEnabledFor(logging.INFO)


@pytest.mark.parametrize(
    ("pairs", "workers", "device", "gpus", "expected"),
    [
        (100, None, CPU, (), (1, 8, (None,))),
        (100, 3, CPU, (), (3, 2, (None,) * 3)),
        (100, 20, CPU, (), (20, 1, (None,) * 20)),
        (2, 8, CPU, (), (2, 4, (None,) * 2)),
        (0, 8, CPU, (), (1, 8, (None,))),
        (100, None, GPU, ("0",), (1, 8, (None,))),
        (100, None, GPU, ("0", "GPU-5c"), (2, 4, ("0", "GPU-5c"))),
        (100, None, GPU, FOUR, (4, 2, FOUR)),
        (100, 2, GPU, FOUR, (2, 4, ("0", "1"))),
        (3, None, GPU, FOUR, (3, 2, ("0", "1", "2"))),
        (1, None, GPU, FOUR, (1, 8, (None,))),
        (100, 3, GPU, ("2", "7"), (3, 2, ("2", "7", "2"))),
        (100, 1, GPU, FOUR, (1, 8, (None,))),
        (100, 2, GPU, ("0",), (2, 4, (None, None))),
    ],
)
def test_pairs_are_shared_out_to_cores_and_gpus(pairs, workers, device, gpus, expected, caplog):
    with caplog.at_level("INFO", "lfpiv.runs.worker_plan"):
        assert worker_plan.plan(pairs, workers, device, gpus) == worker_plan.Plan(*expected, device.kind)
    unusual = len(gpus) > 1 and expected[0] != len(gpus)
    assert [f"{len(gpus)} GPUs" in text for text in caplog.messages] == [True] * unusual, "the user is not told"


@pytest.mark.parametrize(
    ("listed", "count", "names"),
    [
        (None, 4, FOUR),
        (None, 0, ()),
        ("", 0, ()),
        ("2,3", 2, ("2", "3")),
        (" GPU-5c01, GPU-77aa ", 2, ("GPU-5c01", "GPU-77aa")),
        ("1,0,9,2", 2, ("1", "0")),  # there is no 9: CUDA stops before it
        ("-1", 0, ()),
        (
            "MIG-aa,MIG-bb",
            1,
            ("MIG-aa", "MIG-bb"),
        ),  # CUDA shows a process one part of a GPU
        ("MIG-GPU-5c01/1/0", 1, ("MIG-GPU-5c01/1/0",)),
    ],
)
def test_gpus_are_named_as_the_cluster_gave_them(listed, count, names):
    assert worker_plan.gpu_names(listed, count) == names


def test_several_gpus_do_not_ask_for_a_package_nobody_asked_for(monkeypatch, caplog):
    plan = worker_plan.plan(100, None, GPU, FOUR)
    assert worker_plan.fit_installation(plan, GPU) == plan
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert worker_plan.fit_installation(plan, GPU) == worker_plan.Plan(1, 8, (None,), "cuda")
    assert "one of 4 GPUs" in caplog.text and "pip install 'lfpiv[distributed]'" in caplog.text
    one = worker_plan.plan(100, None, GPU, ("0",))
    assert worker_plan.fit_installation(one, GPU) == one


@pytest.mark.parametrize("workers", [0, -1, 10**6, 2.0, True])
def test_a_number_of_workers_that_makes_no_sense_is_refused(workers):
    with pytest.raises(InputError, match="--workers"):
        worker_plan.plan(10, workers, CPU)


def test_workers_must_fit_into_the_memory_together(small_run, monkeypatch):
    experiment, weights = read_experiment(small_run.experiment), 3 * memory.GIB
    each = memory.worker_bytes(experiment)
    need = memory.run_bytes(experiment, weights, 4)
    assert need >= weights + 4 * each and memory.run_bytes(experiment, weights, 5) == need + each
    monkeypatch.setattr(memory, "available_bytes", lambda: need - 1)
    with pytest.raises(InputError, match=r"--workers 4: .*3\.0 GiB .*that 4 workers share.* --workers 3"):
        worker_plan.require_memory(experiment, weights, 4)
    worker_plan.require_memory(experiment, weights, 3)
    plan = worker_plan.plan(100, 4, CPU)
    assert worker_plan.fit_memory(plan, experiment, weights, CPU) == worker_plan.Plan(3, 2, (None,) * 3)
    assert worker_plan.fit_memory(plan, experiment, weights // 2, CPU) == plan
    monkeypatch.setattr(memory, "available_bytes", lambda: weights)
    with pytest.raises(InputError, match=r"volume: .*need at least"):
        worker_plan.require_memory(experiment, weights, 4)


@pytest.fixture(scope="module")
def weights():
    """Weights of a small ideal rig; the smallest grid whose voxels light whole microimages."""
    return lfpiv.build_weights(
        two_cameras(), Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(0.8, 0.7, 0.6), voxel_mm=0.1)
    )


def test_stored_weights_are_the_same_operator(weights, tmp_path):
    content = storage.save_weights(weights, tmp_path / "store")
    opened = storage.open_weights(tmp_path / "store", weights.cameras, content)
    rng = np.random.default_rng(0)
    volume = rng.random(weights.grid.shape, np.float32)
    images = {name: rng.random(camera.optics.sensor_shape, np.float32) for name, camera in weights.cameras.items()}
    projected, seen = weights(volume), opened(volume)
    for name in weights.cameras:
        assert np.array_equal(projected[name], seen[name])
        blocks = opened.projector(name).blocks
        assert isinstance(blocks.value.base, np.memmap) and not blocks.value.flags.writeable  # shared, not copied
    back = opened.T(images)
    assert np.array_equal(weights.T(images), back) and np.array_equal(weights.column_sum, opened.column_sum)
    assert (opened.largest, opened.forms, opened.method) == (weights.largest, weights.forms, weights.method)
    assert storage.save_weights(opened, tmp_path / "again") == content


def test_other_or_incomplete_weights_are_refused(weights, tmp_path):
    store = tmp_path / "store"
    content = storage.save_weights(weights, store)
    for cameras, wanted in (({"cam1": None}, content), (weights.cameras, "of another run")):
        with pytest.raises(InputError, match=r"weights\.json"):
            storage.open_weights(store, cameras, wanted)
    largest = max(store.glob("*.npy"), key=lambda path: path.stat().st_size)
    os.truncate(largest, largest.stat().st_size // 2)
    with pytest.raises(InputError, match="none that fit"):
        storage.open_weights(store, weights.cameras, content)
    (store / "weights.json").unlink()
    with pytest.raises(InputError, match="No such file"):
        storage.open_weights(store, weights.cameras)


class DeadlyClient:
    """A Dask client whose workers die of some pairs, as often as `deaths` says; or whose connection breaks as often."""

    def __init__(self, deaths, result=None, how="error"):
        self.deaths, self.result, self.how, self.submitted, self.keys = dict(deaths), result, how, [], set()

    def submit(self, function, shared, unit, topic, name, *, key, pure, **options):
        (pair,) = unit.pairs
        assert key not in self.keys, "the cluster would hand out what it knows under this key"
        self.keys.add(key)
        self.submitted.append(pair)
        self.deaths[pair] = self.deaths.get(pair, 0) - 1
        status = self.how if self.deaths[pair] >= 0 else "finished"
        return Done(key, status, self.result or Result(outcomes=(Outcome(pair=pair),)))

    def subscribe_topic(self, topic, handler):
        handler((0.0, ("", 0.5)))

    def unsubscribe_topic(self, topic):
        pass


def outcomes(client, todo, width=2):
    fractions = []
    units = cut(todo, None, width)
    work = dispatch.Dispatch(client, lambda: width, Path("shared"), units, len(todo))
    found = list(work.outcomes(fractions.append))
    assert fractions == sorted(fractions) and fractions[-1] <= 1
    return {outcome.pair: outcome.reason for outcome in found}


def test_a_pair_that_kills_its_worker_twice_has_failed():
    """Each is tried once more, after all others; who dies once is done, who dies again is named."""
    client = DeadlyClient({1: 1, 2: 9})
    reasons = outcomes(client, range(6))
    assert sorted(reasons) == list(range(6)) and [pair for pair in reasons if reasons[pair]] == [2]
    assert "its worker died, in each of two trials" in reasons[2]
    assert sorted(client.submitted[:6]) == list(range(6)) and sorted(client.submitted[6:]) == [1, 2]


def test_a_broken_connection_is_no_trial_of_a_pair():
    """What the scheduler forgot is handed out again, however often."""
    client = DeadlyClient({1: 3, 2: 1}, how="cancelled")
    assert outcomes(client, range(4)) == dict.fromkeys(range(4), "")
    assert len(client.submitted) == 4 + 3 + 1


def test_what_stops_all_pairs_ends_the_run():
    for full, kind in ((True, StorageError), (False, InputError)):
        with pytest.raises(kind, match="no room"):
            outcomes(DeadlyClient({}, Result(outcomes=None, fatal="no room", storage=full)), range(3))


def test_a_scheduler_that_hangs_is_told_and_given_up(monkeypatch, caplog):
    """The clock is the test's own: nothing until a minute has passed, then a word each minute, an error at last."""
    now = [0.0]
    monkeypatch.setattr(cluster_workers, "time", SimpleNamespace(monotonic=lambda: now[0]))
    watch = cluster_workers.SchedulerWatch(SimpleNamespace(status="running"), "tcp://there:1")
    watch.answer = Future()
    with caplog.at_level("INFO", "lfpiv.runs.cluster_workers"):
        for now[0] in np.arange(0.0, cluster_workers.SILENT_S, 1.0):
            assert watch.capacity() > 1e6
    assert len(caplog.messages) == cluster_workers.SILENT_S // cluster_workers.REMIND_S - 1
    assert all("tcp://there:1 has not answered for" in text for text in caplog.messages)
    now[0] = cluster_workers.SILENT_S + 1
    with pytest.raises(ClusterError, match=r"tcp://there:1 has not answered for 601 s\. Finished results are complete"):
        watch.capacity()
    watch.answer.set_result(0)
    assert watch.capacity() > 1e6 and watch.count == 0, "it answered after all"
    watch.client.status = "connecting"
    assert watch.capacity() == 0
    watch.client.status = "closed"
    with pytest.raises(ClusterError, match="tcp://there:1 is gone"):
        watch.capacity()


@pytest.mark.parametrize(("granted", "expected"), [(None, 16), ("4", 4), ("64", 16)])
def test_a_worker_uses_the_cores_that_its_job_was_given(monkeypatch, granted, expected):
    monkeypatch.setattr(dispatch, "cores", lambda: 16)
    monkeypatch.delenv("SLURM_CPUS_PER_TASK", raising=False)
    if granted is not None:
        monkeypatch.setenv("SLURM_CPUS_PER_TASK", granted)
    assert dispatch.granted_cores() == expected


@pytest.mark.slow
def test_what_workers_are_forked_from_is_whole_and_has_started_nothing():
    """A device or a thread of Python would not survive the fork; a module that cannot be read would be passed over."""
    script = "import threading, lfpiv.runs.worker_preload; from lfpiv_kernels import runtime"
    script += "; print(runtime._device, runtime._pool, threading.active_count())"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.split() == ["None", "None", "1"]


@pytest.mark.slow(but="options1")
@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--scheduler", "nonsense://x"], ["--scheduler", "tcp://host:8786", "nonsense"]),
        (["--scheduler", "tcp://127.0.0.1:9", "--workers", "2"], ["--workers, --scheduler", "one of them"]),
        (["--workers", "0"], ["--workers", "whole number"]),
    ],
)
def test_workers_that_cannot_be_had_are_refused(small_run, tmp_path, capfd, options, words):
    out = small_run.calibrated(tmp_path / "out")
    assert commands.call(["run", str(small_run.experiment), "--out", str(out), *options]) == 2
    said = capfd.readouterr().err.splitlines()[-1]
    assert said.startswith("lfpiv: ") and all(word in said for word in words), said
    assert {path.name for path in out.iterdir()} <= {"background.h5", "calibration.h5", "guard.json", "refinement.json"}


def test_without_dask_its_extra_is_named(small_run, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"pip install 'lfpiv\[distributed\]'"):
        pipeline.run(small_run.experiment, small_run.calibrated(tmp_path / "out"), workers=2)


@pytest.mark.slow
def test_finishing_thousands_of_pairs_opens_each_file_at_most_twice(small_run, tmp_path, monkeypatch):
    """A count, no clock: what is there is noticed from the heads of the files, once, and summed up from them, once."""
    pairs, file = 300, small_run.images(tmp_path / "data")
    several = file.read_text().replace(f"pairs = {PAIRS}", f"pairs = {pairs}")
    file.write_text(several + "\n[bootstrap]\npairs = 0\n")  # it would read vectors
    out, experiment = small_run.calibrated(tmp_path / "out"), read_experiment(file)
    (out / "vectors").mkdir()
    calibration = stamps.of_calibration(experiment).hash
    content = (small_run.out / "vectors" / "pair_0000.nc").read_bytes()
    least = guard.layers(experiment, None)  # nothing is measured: most of the images are missing
    for pair in range(pairs):
        path = out / "vectors" / f"pair_{pair:04d}.nc"
        path.write_bytes(content)
        marks = stamps.of_pair(experiment, Inputs(calibration, guard=least), pair).vectors.attributes
        stamp = marks | {datasets.FILE: path.name}
        rewrite(path, lambda file, stamp=stamp: file.attrs.update(stamp), sealed=True)
    opened, read_marks = [], provenance.read_marks
    monkeypatch.setattr(provenance, "read_marks", lambda path: opened.append(path) or read_marks(path))
    monkeypatch.setattr(netcdf, "read_vectors", lambda path: pytest.fail(f"{path} is read as a whole"))
    summary = pipeline.run(experiment, out)
    assert len(summary["pairs"]) == pairs and summary["failed"] == []
    assert sum("pair_" in path.name for path in opened) <= 2 * pairs


def test_a_clock_that_is_set_back_ends_the_run_and_does_not_hang_it(monkeypatch):
    """Dask would wait until the clock shows the old time again. Small steps, and steps forward, end nothing."""
    now = {"time": 1e9, "monotonic": 5.0}
    clock = SimpleNamespace(time=lambda: now["time"], monotonic=lambda: now["monotonic"])
    monkeypatch.setattr(local_workers, "time", clock)
    monkeypatch.setattr(cluster_workers, "time", clock)
    watch = cluster_workers.SchedulerWatch(SimpleNamespace(status="running"), "tcp://there:1")
    watch.answer = Future()
    require_clock = local_workers.clock_watch()
    for step in (0.0, -3.0, 3.0, 7200.0, -local_workers.SET_BACK_S):
        now["time"] += step + 1
        now["monotonic"] += 1
        require_clock()
        watch.capacity()
    now["time"] -= 1
    for check in (require_clock, watch.capacity):
        with pytest.raises(ClusterError, match=r"set back by 11 s.*goes on from there"):
            check()


@pytest.mark.slow
def test_only_processes_of_the_run_on_this_machine_can_send_work(tmp_path):
    """Scheduler and workers listen on localhost, and answer nobody without the run's certificate."""
    plan, me = worker_plan.Plan(1, 1, (None,)), psutil.Process()
    others = set(me.children(recursive=True))  # of other tests, such as the driver of a browser
    with local_workers.workers(plan, tmp_path) as (client, capacity):
        end = time.monotonic() + 120
        while not capacity() and time.monotonic() < end:
            time.sleep(0.05)
        assert client.submit(sum, (1, 2)).result(60) == 3
        listening = {
            connection.laddr
            for process in (me, *(set(me.children(recursive=True)) - others))
            for connection in process.net_connections()
            if connection.status == psutil.CONN_LISTEN
        }
        assert {place.ip for place in listening} == {"127.0.0.1"} and len(listening) >= 3
        address = client.scheduler.address
        assert address.startswith("tls://127.0.0.1:")
        with pytest.raises((OSError, RuntimeError)):
            Client(address.replace("tls://", "tcp://"), timeout=2, set_as_default=False)
        with pytest.raises((OSError, RuntimeError)):
            Client(address, security=Security.temporary(), timeout=2, set_as_default=False)


@pytest.mark.parametrize(
    ("name", "error", "words"),
    [
        ("socket.create_connection", OSError(101, "Network is unreachable"), "network is unreachable.*--workers 1"),
        (
            "multiprocessing.context.BaseContext.Semaphore",
            FileNotFoundError(2, "No such file"),
            "/dev/shm.*--workers 1",
        ),
    ],
)
def test_where_processes_cannot_reach_each_other_the_run_is_refused_at_once(monkeypatch, name, error, words):
    def refuse(*arguments, **options):
        raise error

    monkeypatch.setattr(name, refuse)
    with pytest.raises(InputError, match=words):
        local_workers.start_preloading("cpu")


def test_without_cryptography_its_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "cryptography", None)
    with (
        pytest.raises(InputError, match=r"`cryptography`.*pip install 'lfpiv\[distributed\]'"),
        local_workers.workers(worker_plan.Plan(1, 1, (None,)), tmp_path),
    ):
        pass
