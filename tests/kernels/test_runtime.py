"""The owner of Taichi's and Warp's state, in processes of its own: what one process may do only once."""

import os
import resource
import subprocess
import sys

import pytest

from lfpiv_kernels import caches

FORKED = """
import os, sys
os.close(2)
from lfpiv_kernels import runtime
assert runtime.start("cpu", threads=2).kind == "cpu"
child = os.fork()
if child:
    sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
for ask in (runtime.device, lambda: runtime.run_chunks(8, print)):
    try:
        ask()
    except RuntimeError as error:
        print(error, flush=True)
    else:
        os._exit(1)
os._exit(0)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="no fork there")
def test_kernels_start_without_standard_error_and_a_forked_process_says_that_it_has_none():
    """Its threads stayed in the process it was forked from, so kernels there would never end."""
    done = subprocess.run([sys.executable, "-c", FORKED], stdout=subprocess.PIPE, text=True, timeout=60)
    assert done.returncode == 0, done.stdout
    assert done.stdout.count("'spawn' or 'forkserver'") == 2


START = (
    "from lfpiv_kernels import runtime; runtime.start('cpu', threads=1); from taichi.lang import impl; print('runs')"
)


def started(environment, limit=None):
    """Start the kernels in a process of its own, with other variables of the environment (None: not set)."""
    names = {"WARP_CACHE_PATH": None, "TI_OFFLINE_CACHE_FILE_PATH": None, "XDG_CACHE_HOME": None} | environment
    variables = {name: value for name, value in {**os.environ, **names}.items() if value is not None}
    limited = None if limit is None else lambda: resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    return subprocess.run(
        [sys.executable, "-c", START], env=variables, capture_output=True, text=True, timeout=120, preexec_fn=limited
    )


def test_kernels_start_without_a_home_directory(tmp_path):
    """Taichi alone would abort the process on import."""
    done = started({"HOME": None, "TMPDIR": str(tmp_path)})
    assert (done.returncode, done.stdout) == (0, "runs\n"), done.stderr


@pytest.mark.slow
def test_kernels_start_where_the_home_directory_cannot_be_written(tmp_path):
    """One line says where compiled kernels are; a second process uses them, and trusts no folder of others."""
    for private in (True, False):
        done = started({"HOME": "/proc", "TMPDIR": str(tmp_path)})
        assert (done.returncode, done.stdout) == (0, "runs\n"), done.stderr
        (folder,) = (path for path in tmp_path.iterdir() if path.name.startswith("lfpiv-cache"))
        assert folder.stat().st_mode & 0o777 == (0o700 if private else 0o777)
        assert done.stderr.count("cannot be written") == 1 and (f"{folder}," in done.stderr) == private, done.stderr
        folder.chmod(0o777)


@pytest.mark.slow
def test_too_little_address_space_is_named():
    done = started({}, limit=1 << 30)
    assert done.returncode == 1 and "ulimit -v" in done.stderr.splitlines()[-1], done.stderr


COMPILE = """
import logging, sys
logging.basicConfig(level="INFO", format="%(message)s", stream=sys.stdout)
import numpy as np
from lfpiv_kernels import runtime
runtime.start("cpu", threads=1)
from lfpiv_kernels.correlation import box_sum
for _ in range(2):
    box_sum.box_sum(np.ones((4, 4, 4), np.float32), (2, 2, 2))
"""


@pytest.mark.slow
def test_compilation_is_told_once_and_only_when_there_is_some(tmp_path):
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path)}
    environment.pop("WARP_CACHE_PATH", None)
    told = []
    for _ in range(2):
        done = subprocess.run(
            [sys.executable, "-c", COMPILE], env=environment, capture_output=True, text=True, timeout=300
        )
        assert done.returncode == 0 and done.stderr == "", done.stderr
        told.append([line for line in done.stdout.splitlines() if line.startswith("compiling kernels, once")])
    assert [len(lines) for lines in told] == [1, 0] and str(tmp_path) in told[0][0]


def test_taichi_is_silent_where_standard_output_is_wrapped(tmp_path):
    """Taichi logs, by native code, that it found a graphical shell."""
    script = "import io, sys\nsys.stdout = io.StringIO()\nimport lfpiv_kernels.rays.mapping"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def names(folder):
    return {path.name for path in folder.iterdir() if path.suffix in (".tic", ".tcb")}


def test_changed_kernels_of_taichi_are_removed_and_told(tmp_path, caplog):
    """With a changed index all are removed; those of a killed process, which has recorded nothing, without a word."""
    kernels = ("a.tic", "b.tic", "ticache.tcb")

    def compile_all():
        for name in kernels:
            (tmp_path / name).write_bytes(name.encode() * 100)

    def after(name, content):
        caches.seal_taichi(tmp_path, compile_all)
        caches.verify_taichi(tmp_path)
        assert names(tmp_path) == set(kernels) and not caplog.records
        (tmp_path / name).write_bytes(content)
        caches.verify_taichi(tmp_path)
        told, left = len(caplog.records), names(tmp_path)
        caplog.clear()
        return told, left

    assert after("b.tic", b"b") == (1, {"a.tic", "ticache.tcb"})
    assert after("ticache.tcb", b"") == (1, set())
    assert after("c.tic", b"c") == (0, set(kernels))
    assert after(caches.DIGESTS, b"{") == (1, set())
    (tmp_path / caches.DIGESTS).unlink()
    compile_all()
    caches.verify_taichi(tmp_path)
    assert names(tmp_path) == set() and not caplog.records


@pytest.mark.parametrize("spoilt", ["one.meta", "one.cpu.o", caches.DIGESTS])
def test_changed_modules_of_warp_are_removed_and_told(tmp_path, caplog, spoilt):
    modules = [tmp_path / f"wp_lfpiv_kernels.{name}" for name in ("one", "two", "three_p12_t34")]
    others = tmp_path / "wp_somebody_else"
    for module in (*modules, others):
        module.mkdir()
        for name in ("one.meta", "one.cpu.o", "one.cpp"):
            (module / name).write_text('{"a": 1}')
    for _ in range(2):
        caches.verify_warp(tmp_path)
        assert all(module.exists() for module in modules) and not caplog.records
    (modules[0] / "one.cpp").write_text("is not read again")
    caches.verify_warp(tmp_path)
    assert modules[0].exists()
    for module in (modules[0], others):
        (module / spoilt).write_bytes(b"\xff\xfe{")
    caches.verify_warp(tmp_path)
    assert not modules[0].exists() and modules[1].exists() and others.exists() and len(caplog.records) == 1


def test_a_module_of_warp_that_was_never_recorded_must_be_readable(tmp_path, caplog):
    module = tmp_path / "wp_lfpiv_kernels.one"
    module.mkdir()
    (module / "one.meta").write_bytes(b"\xff\xfe")
    caches.verify_warp(tmp_path)
    assert not module.exists() and len(caplog.records) == 1
