"""What goes wrong at night: killed processes, full disks, damaged images, a second run; real processes and signals."""

import contextlib
import functools
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
from support.small_run import BRIEF, PAIRS, damage, same_vectors, start

from lfpiv import open_results
from lfpiv.cli import commands
from lfpiv.errors import InputError
from lfpiv.results.folder import Folder
from lfpiv.runs.frame_light import frame_light

ROOT = Path(__file__).resolve().parents[2]

PATIENCE_S = 300.0
"""Longest wait for something that must happen [s]: many times what it takes, for a machine that does much else."""

HANG_S = 8.0
"""Longer than a run waits before it asks the scheduler, shorter than it takes to give it up [s]."""


def wait_for(condition, process, what):
    """Wait until something is true while a process runs; fails where the process ends before."""
    end = time.monotonic() + PATIENCE_S
    while not (found := condition()):
        if process.poll() is not None:
            pytest.fail(f"the run ended with {process.returncode} before {what}: {process.stderr.read()}")
        assert time.monotonic() < end, f"no {what} in {PATIENCE_S:g} s"
        time.sleep(0.02)
    return found


def workers_of(process, shared=".shared"):
    """Worker processes of a run: those that have mapped the shared weights."""
    found = []
    for child in psutil.Process(process.pid).children(recursive=True):
        try:
            if any(shared in mapped.path for mapped in child.memory_maps()):
                found.append(child)
        except psutil.Error:
            continue
    return found


def gone(processes):
    _, alive = psutil.wait_procs(processes, timeout=PATIENCE_S)
    return not alive


def finished(out):
    return [path.name for path in (out / "vectors").glob("pair_*.nc")] if (out / "vectors").exists() else []


def whole(out):
    """Whether nothing is in a folder but finished results."""
    left = {path.name for path in out.rglob("*") if path.is_file() and path.suffix != ".nc"}
    results = {"background.h5", "calibration.h5", "guard.json", "refinement.json", "summary.json", "report.html"}
    kept = {".record.json", "calibration_left.h5", "calibration_right.h5"}
    return left <= results | kept and not (out / ".shared").exists()


def dask(*arguments):
    """Start a part of a cluster as a user does, and in its own group, which ends it as a whole."""
    command = [sys.executable, "-m", "dask", *map(str, arguments), "--no-dashboard", "--host", "127.0.0.1"]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)


@pytest.fixture
def cluster(tmp_path):
    """A Dask cluster of processes: its address, its scheduler, and a function that starts a worker."""
    file, started = tmp_path / "scheduler.json", []

    def worker():
        started.append(dask("worker", "--scheduler-file", file, "--nthreads", 1, "--death-timeout", 60))
        return started[-1]

    started.append(dask("scheduler", "--port", 0, "--scheduler-file", file))
    try:
        wait_for(lambda: file.exists() and file.stat().st_size, started[0], "scheduler")
        yield json.loads(file.read_text())["address"], started[0], worker
    finally:
        for process in started:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


@pytest.mark.slow
def test_a_cluster_outlives_a_killed_run_and_a_run_outlives_its_workers(coarse_run, tmp_path, cluster):
    """Kill -9 the run, then in the next run a worker; let the scheduler hang for a while: the same numbers."""
    address, scheduler, start_worker = cluster
    out, worker = coarse_run.prepared(tmp_path / "out"), start_worker()
    run = start("run", coarse_run.experiment, "--out", out, "--scheduler", address)
    wait_for(lambda: finished(out), run, "finished pair")
    (dead,) = (out / ".shared").iterdir()
    run.kill()
    run.communicate()
    assert 0 < len(finished(out)) < PAIRS and worker.poll() is None
    run = start("run", coarse_run.experiment, "--out", out, "--scheduler", address)
    shared = wait_for(lambda: not dead.exists() and next((out / ".shared").glob("[!.]*"), None), run, "shared weights")
    wait_for(lambda: workers_of(worker, str(shared)), run, "pair")[0].kill()
    scheduler.send_signal(signal.SIGSTOP)
    time.sleep(HANG_S)
    assert run.poll() is None
    scheduler.send_signal(signal.SIGCONT)
    _, said = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 0, said
    assert same_vectors(coarse_run.out, out) == PAIRS and whole(out)
    assert worker.poll() is None and scheduler.poll() is None, "the cluster is not ours to end"


SBATCH = """#!/bin/sh
# a queue that starts every job at once, on this machine
[ "$1" = --test-only ] && exec cat > /dev/null
cp "$1" "$JOBS/script"
SLURM_CPUS_PER_TASK=$(sed -n "s/#SBATCH --cpus-per-task=//p" "$1") setsid sh "$JOBS/script" > /dev/null 2>&1 &
touch "$JOBS/$!.job"
echo "Submitted batch job $!"
"""
SCANCEL = """#!/bin/sh
kill -- "-$1"
"""


@pytest.mark.slow
def test_under_slurm_a_cancelled_job_is_replaced(coarse_run, tmp_path):
    """The documented script and dask-jobqueue, processes for jobs: one job is cancelled, one pair cannot be done."""
    (tmp_path / "bin").mkdir()
    for name, text in (("sbatch", SBATCH), ("scancel", SCANCEL)):
        (tmp_path / "bin" / name).write_text(text)
        (tmp_path / "bin" / name).chmod(0o755)
    experiment, out = coarse_run.images(tmp_path / "data"), coarse_run.prepared(tmp_path / "out")
    damage(next((tmp_path / "data").rglob("*0003*")))
    command = [sys.executable, ROOT / "docs" / "slurm.py", experiment.relative_to(tmp_path), "out", "--jobs", "1"]
    environment = {
        "PATH": os.pathsep.join([str(tmp_path / "bin"), os.environ["PATH"]]),
        "PYTHONPATH": str(ROOT),
        "JOBS": str(tmp_path),
    }
    run = subprocess.Popen(
        [*command, "--cores", "1", "--memory", "2GB", "--walltime", "00:10:00", "--queue", "normal"],
        cwd=tmp_path,
        env={**os.environ, **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    wait_for(lambda: finished(out), run, "finished pair")
    (job,) = tmp_path.glob("*.job")
    os.killpg(int(job.stem), signal.SIGTERM)
    written, said = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 3, said
    assert "pair 3:" in written and "damaged" in written
    assert "pair 0: " in said and "kernels run on cpu" in said and "1 thread" in said, "what workers log is lost"
    assert len(list(tmp_path.glob("*.job"))) > 1 and (tmp_path / "slurm-logs").is_dir()
    for folder in (reference := coarse_run.results(tmp_path / "reference"), out):
        (folder / "vectors" / "pair_0003.nc").unlink(missing_ok=True)
    assert same_vectors(reference, out) == PAIRS - 1 and whole(out)


@pytest.mark.slow
@pytest.mark.parametrize(("number", "options"), [(signal.SIGINT, ["--workers", "2"]), (signal.SIGTERM, [])])
def test_an_interrupted_run_ends_cleanly_and_says_how_to_go_on(coarse_run, tmp_path, number, options):
    out = coarse_run.prepared(tmp_path / "out")
    file = coarse_run.images(tmp_path / "data")
    slow = file.read_text("utf-8").replace("iterations = 8", "iterations = 400\ntolerance = 0.0")
    assert slow.count("iterations = 400") == 1
    file.write_text(slow, "utf-8")  # seconds for each pair: none may be done before the signal comes
    run = start("run", file, "--out", out, *options)
    wait_for(lambda: workers_of(run) if options else (out / ".lock").exists(), run, "work")
    children = psutil.Process(run.pid).children(recursive=True)
    run.send_signal(number)
    _, said = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 1 and "the same command goes on from there" in said.splitlines()[-1]
    assert "Traceback" not in said
    assert gone(children) and whole(out) and len(finished(out)) < PAIRS


def mounts():
    """Whether this user may mount a file system of its own."""
    command = ["unshare", "-m", "mount", "-t", "tmpfs", "-o", "size=100k", "tmpfs", "/mnt"]
    return shutil.which("unshare") and subprocess.run(command, capture_output=True).returncode == 0


@pytest.mark.slow
def test_a_full_disk_leaves_nothing_half_written(coarse_run, tmp_path):
    """The second pair's vectors do not fit: one clear message, status 1, every file whole."""
    out = coarse_run.prepared(tmp_path / "out")
    room = (coarse_run.out / "vectors" / "pair_0000.nc").stat().st_size
    command = [sys.executable, "-c", BRIEF, "run", str(coarse_run.experiment), "--out", str(out)]
    (out / "vectors").mkdir()
    if mounts():  # the listing shows what is on the small disk, which ends with the namespace
        mount = f"mount -t tmpfs -o size={3 * room // 2} tmpfs {out}/vectors"
        script = f'{mount} && "$@"; status=$?; ls -A {out}/vectors; exit $status'
        done = subprocess.run(["unshare", "-m", "sh", "-c", script, "sh", *command], capture_output=True, text=True)
        assert done.stdout.split() == ["pair_0000.nc"] and "no space left" in done.stderr, done.stderr
    else:  # no disk, but files that may not grow: the first pair's do not fit
        smaller = functools.partial(resource.setrlimit, resource.RLIMIT_FSIZE, (room // 2, room // 2))
        done = subprocess.run(command, capture_output=True, text=True, preexec_fn=smaller)
        assert "file too large" in done.stderr, done.stderr
    last = done.stderr.splitlines()[-1]
    assert done.returncode == 1 and "cannot be written: " in last and "the same command goes on" in last
    assert "Traceback" not in done.stderr and whole(out) and not finished(out)


HOLDER = """
import sys, time
from pathlib import Path
from lfpiv.results.folder import Folder
with Folder(Path(sys.argv[1])).held():
    print("held", flush=True)
    time.sleep(600)
"""


def test_a_second_run_on_one_folder_is_refused(coarse_run, tmp_path, capfd):
    """It names who holds the folder; a report may be made meanwhile; kill -9 leaves no stale lock."""
    out = coarse_run.results(tmp_path / "out")
    holder = subprocess.Popen([sys.executable, "-c", HOLDER, out], stdout=subprocess.PIPE, text=True)
    try:
        assert holder.stdout.readline() == "held\n"
        for command in ("run", "calibrate", "reconstruct", "correlate"):
            assert commands.call([command, str(coarse_run.experiment), "--out", str(out)]) == 2
            said = capfd.readouterr().err.splitlines()[-1]
            assert f"process {holder.pid}" in said and "no other run writes to" in said
        assert commands.call(["report", str(coarse_run.experiment), "--out", str(out)]) == 0
    finally:
        holder.kill()
        holder.wait()
    assert (out / ".lock").exists()
    with Folder(out).held(), pytest.raises(InputError, match=f"process {os.getpid()}"), Folder(out).held():
        pass
    assert not (out / ".lock").exists()


def test_bad_pairs_are_named_and_left_out(coarse_run, tmp_path, capfd, monkeypatch):
    """Missing, of another shape, not finite, gone when its turn comes; the first pair must be whole."""
    import numpy as np
    import tifffile

    experiment, out = coarse_run.images(tmp_path / "data"), coarse_run.calibrated(tmp_path / "out")
    images = [next((tmp_path / "data").rglob(f"*000{pair}*")) for pair in range(PAIRS)]
    images[1].unlink()
    tifffile.imwrite(images[2], np.ones((40, 30), np.uint16))
    tifffile.imwrite(images[3], np.full((400, 400), np.nan, np.float32))
    read = frame_light

    def late(*arguments):
        images[0].unlink(missing_ok=True)
        return read(*arguments)

    monkeypatch.setattr("lfpiv.runs.frame_light.frame_light", late)
    assert commands.call(["run", str(experiment), "--out", str(out)]) == 3
    written, said = capfd.readouterr()
    failed = {item["pair"]: item["reason"] for item in json.loads((out / "summary.json").read_text())["failed"]}
    words = ["no such file", "no such file", "(40, 30)", "NaN"]
    assert list(failed) == list(range(PAIRS)) and f"{PAIRS} of {PAIRS} pairs failed" in written
    assert said.count("The other pairs will be done") == PAIRS - 1, "each is told once"
    for pair, word in enumerate(words):
        assert word in failed[pair] and images[pair].name in failed[pair]
        assert pair == 0 or word in said.split("image pairs")[0], "the user is not told before the work"
    assert commands.call(["run", str(experiment), "--out", str(out), "--pairs", "1:"]) == 2
    assert images[1].name in capfd.readouterr().err.splitlines()[-1]
    assert not finished(out) and whole(out)


@pytest.mark.slow
def test_a_failed_pair_blocks_no_other_and_its_failure_ends_when_it_is_mended(coarse_run, tmp_path, capfd):
    """Each status tells of its own invocation; results of other images than there are now are put aside."""
    experiment, out = coarse_run.images(tmp_path / "data"), coarse_run.results(tmp_path / "out")
    spoilt = next((tmp_path / "data").rglob("*0002*"))
    good, stated = spoilt.read_bytes(), experiment.read_text()
    damage(spoilt)
    (out / "vectors" / "pair_0003.nc").unlink()

    def called(*arguments):
        status = commands.call([arguments[0], str(experiment), "--out", str(out), *arguments[1:]])
        summary = json.loads((out / "summary.json").read_text())
        return status, [item["pair"] for item in summary["failed"]], [pair["pair"] for pair in summary["pairs"]]

    assert called("run") == (3, [2], [0, 1, 3]), "the pair after it was not done"
    assert open_results(out).pair.values.tolist() == [0, 1, 3], "vectors of images that are no more are in use"
    aside = [path.name for path in out.rglob("*.outdated")]
    assert sorted(aside) == ["pair_0002.outdated", "pair_0002_a.outdated", "pair_0002_b.outdated"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "lfpiv.weights.operator.build_weights", lambda *arguments, **more: pytest.fail("weights for no pair")
        )
        assert called("run") == (3, [2], [0, 1, 3])
        capfd.readouterr()
        assert called("run", "--pairs", "0:1") == (0, [2], [0, 1, 3])
        assert "1 of 4 pairs failed in earlier runs" in capfd.readouterr().out
        experiment.write_text(stated.replace(f"pairs = {PAIRS}", "pairs = 2"))
        assert called("run") == (0, [], [0, 1]), "a pair that is no more cannot fail"
        experiment.write_text(stated)
        assert called("run") == (3, [2], [0, 1, 3])
    spoilt.write_bytes(good)
    assert called("reconstruct", "--pairs", "2:") == (0, [], [0, 1, 3])
    assert called("run", "--keep-volumes") == (0, [], [0, 1, 2, 3])
    assert same_vectors(coarse_run.out, out) == PAIRS and not list(out.rglob("*.outdated"))


@pytest.mark.slow
def test_a_run_that_goes_on_does_not_end_at_the_first_damaged_pair(coarse_run, tmp_path, capfd):
    """Stopped after pair 0; pair 1 is damaged, and its volumes are not needed where its images are gone."""
    experiment, out = coarse_run.images(tmp_path / "data"), coarse_run.results(tmp_path / "out")
    for pair in (1, 2, 3):
        (out / "vectors" / f"pair_000{pair}.nc").unlink()
    damage(next((tmp_path / "data").rglob("*0001*")))
    next((tmp_path / "data").rglob("*0003*")).unlink()
    assert commands.call(["run", str(experiment), "--out", str(out)]) == 3
    said = capfd.readouterr().err
    assert "pair 1" in said.split("The other pairs will be done")[0]
    assert sorted(finished(out)) == [f"pair_000{pair}.nc" for pair in (0, 2, 3)]


def test_a_bad_image_of_the_calibration_is_bad_input(coarse_run, tmp_path, capfd):
    experiment = coarse_run.images(tmp_path / "data")
    plane = sorted((tmp_path / "data").rglob("*plane*"))[3]
    damage(plane)
    assert commands.call(["run", str(experiment), "--out", str(tmp_path / "out")]) == 2
    assert Path(plane).name in capfd.readouterr().err and not (tmp_path / "out").exists()


def test_more_pairs_than_there_are_images_are_refused_before_any_work(coarse_run, tmp_path, capfd):
    """A selection of those that are there is done, with a warning of the others."""
    experiment, out = coarse_run.images(tmp_path / "data"), tmp_path / "out"
    experiment.write_text(experiment.read_text().replace(f"pairs = {PAIRS}", f"pairs = {PAIRS + 3}"))
    assert commands.call(["run", str(experiment), "--out", str(out)]) == 2
    (said,) = [line for line in capfd.readouterr().err.splitlines() if line.startswith("lfpiv: ")]
    for words in (f"particles.pairs: expected the images of {PAIRS + 3} pairs", f"found those of {PAIRS}"):
        assert words in said, said
    assert f"State particles.pairs = {PAIRS}" in said and f"--pairs 0:{PAIRS}" in said and not out.exists()
    out = coarse_run.results(tmp_path / "finished")
    (out / "vectors" / "pair_0001.nc").unlink()
    assert commands.call(["run", str(experiment), "--out", str(out), "--pairs", f"0:{PAIRS}"]) == 0
    said = capfd.readouterr().err
    assert f"WARNING {experiment}: particles.pairs: expected the images of {PAIRS + 3} pairs" in said
    assert "vectors (x, y, z)" in said.split("image pairs")[0], "the number of vectors is told before the work"
