"""Worker processes of this machine. Dask starts and watches them. All of them end with the run.

Their messages are code to whoever receives them. So they are encrypted, and only processes with the certificate of this
run can send any: TLS on the machine's own interface, with a certificate that is made for the run and stored nowhere.
"""

from __future__ import annotations

import contextlib
import datetime
import logging
import multiprocessing
import os
import shutil
import signal
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from lfpiv.errors import ClusterError, InputError
from lfpiv.files import remove_leftovers, scratch_path
from lfpiv.runs.worker_plan import Plan

START_S = 300.0
"""Longest time that worker processes may take to start [s]."""
LOOPBACK_S = 2.0
"""Longest time that a connection within the machine may take [s]."""
SET_BACK_S = 10.0
"""Time by which the clock may be set back during a run [s]; Dask's processes wait for as long before they go on."""
CLOSE_S = 10.0
"""Time that Dask is given to close [s]."""

LONGEST_FOLDER = 80
"""Most characters of the folder of a socket. Linux allows 107 for the whole path."""

ROLES = ("client", "scheduler", "worker")
"""Processes that have a certificate in Dask's settings."""

LOCALHOST = "127.0.0.1"
"""Address on which scheduler and workers listen: other machines do not reach it."""

Capacity = Callable[[], float]
"""Return how many pairs may be submitted at once; raise ClusterError if the scheduler is lost."""

SETTINGS = {
    "distributed.worker.profile.enabled": False,  # would look at the workers' stacks 100 times a second
    "distributed.admin.tick.interval": "1s",  # default: 20 ms, in every process
    "distributed.admin.system-monitor.interval": "10s",
    "distributed.scheduler.http.routes": [],  # nobody asks for pages
    "distributed.worker.http.routes": [],
}
"""Settings of Dask that reduce its own load on the processes."""


def import_distributed(key: str) -> Any:
    """Import Dask's `distributed`; raise InputError if it is not installed; `key` is the option that needs it."""
    try:
        import distributed
    except ImportError:
        raise InputError(
            f"{key}: expected the package `distributed`, which several processes need, found none. "
            "Install it: pip install 'lfpiv[distributed]'."
        ) from None
    # It logs a traceback where a connection breaks while something is sent. A run says in one line what is lost.
    logging.getLogger("distributed.batched").setLevel(logging.WARNING)
    return distributed


def start_preloading(kind: str) -> None:
    """Start the process that workers are forked from, and let it import their modules; return at once.

    It imports while this process works, on the calibration for example. It serves all later runs of this process and
    ends with it. CUDA drivers do not survive a fork, so on CUDA this does nothing.

    Raises
    ------
    InputError
        If `distributed` is not installed, or processes cannot reach each other here.
    """
    dask = import_distributed("--workers")
    _require_connections()
    if not _forks(kind):
        return
    from multiprocessing import forkserver, resource_tracker

    with _settings(kind):
        dask.utils.get_mp_context().set_forkserver_preload(["lfpiv.runs.worker_preload"])  # after Dask's own
    _choose_folder_of_sockets()
    resource_tracker.ensure_running()  # must start first: it unblocks Ctrl-C
    path = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path))  # the same modules as here
    try:
        with interrupts_blocked():
            forkserver.ensure_running()
    finally:
        if path is None:
            del os.environ["PYTHONPATH"]
        else:
            os.environ["PYTHONPATH"] = path


def _choose_folder_of_sockets() -> None:
    """Give the sockets of the processes a temporary folder that a later run recognises, should this one be killed."""
    from multiprocessing import process, util

    place = Path(tempfile.gettempdir())
    remove_leftovers(place, ".lfpiv.*.tmp")
    config = process.current_process()._config  # type: ignore[attr-defined]  # where Python keeps its own choice
    folder = scratch_path(place / "lfpiv")
    if config.get("tempdir") is None and len(str(folder)) < LONGEST_FOLDER:
        folder.mkdir(mode=0o700)
        util.Finalize(None, shutil.rmtree, args=(str(folder), True), exitpriority=-100)
        config["tempdir"] = str(folder)


def _require_connections() -> None:
    """Refuse a machine or container on which processes cannot reach each other; Dask would wait for minutes.

    Raises
    ------
    InputError
        If there is no loopback interface, or no shared memory for semaphores.
    """
    try:
        with socket.create_server((LOCALHOST, 0)) as server:
            socket.create_connection(server.getsockname(), timeout=LOOPBACK_S).close()
    except OSError as error:
        raise InputError(
            f"--workers: expected processes that reach each other at {LOCALHOST}, found no connection "
            f"({(error.strerror or str(error)).lower()}). Enable the loopback interface (`ip link set lo up`), or use "
            "--workers 1."
        ) from None
    try:
        multiprocessing.get_context("spawn").Semaphore()
    except (OSError, ImportError) as error:
        raise InputError(
            "--workers: expected semaphores, which processes share in /dev/shm, found that they cannot be made "
            f"({error}). Mount a tmpfs on /dev/shm that can be written (docker: --shm-size), or use --workers 1."
        ) from None


def _forks(kind: str) -> bool:
    """Return whether workers are forked. Libraries of other systems than Linux may not survive a fork."""
    return kind == "cpu" and sys.platform == "linux"


def _settings(kind: str) -> Any:
    """Return a context with the settings of Dask for processes of this machine."""
    import dask

    method = "forkserver" if _forks(kind) else "spawn"
    return dask.config.set(SETTINGS | {"distributed.worker.multiprocessing-method": method})


@contextlib.contextmanager
def workers(planned: Plan, shared: Path) -> Iterator[tuple[Any, Capacity]]:
    """Start worker processes on this machine; yield Dask's client and their capacity. End them in any case."""
    start_preloading(planned.kind)
    with _settings(planned.kind):
        security = _security()
        cluster = _start_scheduler(security)
        finished = False
        try:
            with import_distributed("--workers").Client(cluster, security=security, set_as_default=False) as client:
                cluster.worker_spec.update(_specifications(planned, shared, security))
                cluster.scale(planned.workers)  # starts them
                yield client, _capacity(client, cluster)
                finished = True
        finally:
            if not finished:
                _kill(cluster)
            with contextlib.suppress(Exception):  # processes that do not close end with this one
                cluster.close(timeout=CLOSE_S)


def _security() -> Any:
    """Return a certificate for the processes of one run, which both sides of a connection must show.

    It is that of Dask's ``Security.temporary``, but valid at any time: the clock may be wrong, or set back meanwhile.

    Raises
    ------
    InputError
        If the package `cryptography` is not installed.
    """
    security = import_distributed("--workers").Security
    try:
        from cryptography import x509
        from cryptography.hazmat.primitives import hashes, serialization
        from cryptography.hazmat.primitives.asymmetric import ec
    except ImportError:
        raise InputError(
            "--workers: expected the package `cryptography`, which keeps others from sending work to the processes, "
            "found none. Install it: pip install 'lfpiv[distributed]'."
        ) from None
    secret = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "lfpiv")])
    certificate = (
        x509.CertificateBuilder(subject_name=name, issuer_name=name, public_key=secret.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(datetime.datetime(1970, 1, 1))
        .not_valid_after(datetime.datetime(9999, 12, 31))
        .sign(secret, hashes.SHA256())
        .public_bytes(serialization.Encoding.PEM)
        .decode()
    )
    plain = serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    key = secret.private_bytes(*plain).decode()
    roles = {f"tls_{role}_{kind}": text for role in ROLES for kind, text in (("key", key), ("cert", certificate))}
    return security(require_encryption=True, tls_ca_file=certificate, **roles)


def _start_scheduler(security: Any) -> Any:
    dask = import_distributed("--workers")
    try:
        with interrupts_blocked():
            return dask.SpecCluster(
                scheduler={
                    "cls": dask.Scheduler,
                    # Dask must not repeat a pair whose worker died: `dispatch` decides that
                    "options": {
                        **_listening(security),
                        "allowed_failures": 0,
                        "worker_ttl": None,
                        "dashboard_address": f"{LOCALHOST}:0",
                    },
                },
                security=security,
                silence_logs=logging.CRITICAL,
            )
    except (RuntimeError, OSError) as error:
        reason = " ".join(str(error).split())
        raise ClusterError(f"the processes cannot be started ({reason}). The same command tries it again.") from error


def _listening(security: Any) -> dict[str, Any]:
    return {"host": LOCALHOST, "protocol": "tls://", "security": security, "dashboard": False}


def _specifications(planned: Plan, shared: Path, security: Any) -> dict[int, dict[str, Any]]:
    """Return Dask's specification of every worker by its number."""
    options = {
        **_listening(security),
        "nthreads": 1,
        "memory_limit": 0,
        "local_directory": str(shared / "dask"),
        "silence_logs": logging.CRITICAL,
    }
    nanny = import_distributed("--workers").Nanny
    envs = [{} if device is None else {"CUDA_VISIBLE_DEVICES": device} for device in planned.devices]
    return {number: {"cls": nanny, "options": {**options, "env": env}} for number, env in enumerate(envs)}


def _capacity(client: Any, cluster: Any) -> Capacity:
    """Return a function that counts the workers; it raises if the scheduler ended or no worker starts."""
    last_seen_s, require_clock = time.monotonic(), clock_watch()

    def capacity() -> float:
        nonlocal last_seen_s
        require_clock()
        if client.status != "running":
            raise ClusterError("the scheduler of the workers ended. The same command goes on where it stopped.")
        count = len(cluster.scheduler.workers)
        if count:
            last_seen_s = time.monotonic()
        elif time.monotonic() - last_seen_s > START_S:
            raise RuntimeError(
                "no worker process starts. A script that calls lfpiv.run with workers must do so below "
                '`if __name__ == "__main__":`'
            )
        return count

    return capacity


def clock_watch() -> Callable[[], None]:
    """Return a function that raises ClusterError if the clock was set back by more than `SET_BACK_S` since now.

    Dask and Tornado send messages at times of the clock of the day. They would wait until it shows these times again.
    """
    latest = time.time() - time.monotonic()

    def require_clock() -> None:
        nonlocal latest
        now = time.time() - time.monotonic()
        latest = max(latest, now)
        if now < latest - SET_BACK_S:
            raise ClusterError(
                f"the clock of this machine was set back by {latest - now:.0f} s, and the processes wait for it. "
                "Finished results are complete; the same command goes on from there."
            )

    return require_clock


@contextlib.contextmanager
def interrupts_blocked() -> Iterator[None]:
    """Block Ctrl-C in threads and processes started in this block: only the main process answers it and ends them."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _kill(cluster: Any) -> None:
    """Kill the workers at once. They write files atomically, so no file is damaged."""
    for nanny in list(cluster.workers.values()):
        with contextlib.suppress(Exception):
            nanny.auto_restart = False
            if nanny.pid is not None:
                os.kill(nanny.pid, signal.SIGKILL)
