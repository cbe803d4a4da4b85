"""Seals of stored files: every change is noticed, and what no result holds is refused at once."""

import os
import time

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.stored import rewrite, small_background, small_calibration
from support.vector_sets import random_vectors

import lfpiv
from lfpiv import hdf5, hdf5_structure
from lfpiv.errors import DamagedFile
from lfpiv.results import netcdf
from lfpiv.runs import background
from lfpiv.runs.background import Background

FEWER = settings(max_examples=settings().max_examples // 3, suppress_health_check=[HealthCheck.function_scoped_fixture])
"""For tests that write and read a file for each example."""

QUICK_S = 2.0
"""Time within which what is no file of ours must be refused [s]: it neither waits nor reads."""


def write_vectors(folder):
    path = folder / "pair_0000.nc"
    netcdf.write_vectors(random_vectors(0), path, attributes={"pair": 0, "depends_on": {"volume": 1}})
    return path


def write_volume(folder):
    vectors = random_vectors(0)
    path = folder / "pair_0000_a.nc"
    netcdf.write_volume(abs(vectors["u"]).astype(np.float32), path, attributes={"pair": 0, "frame": "a"})
    return path


def write_calibration(folder):
    path = folder / "calibration.h5"
    small_calibration().save(path)
    return path


def write_background(folder):
    light = small_background(small_calibration())
    path = folder / "background.h5"
    background.write(Background(light, background.content_hash(light)), path, {"settings_hash": "0123"})
    return path


KINDS = {
    "vectors": (write_vectors, netcdf.read_vectors),
    "volume": (write_volume, netcdf.read_volume),
    "calibration": (write_calibration, lfpiv.load_calibration),
    "background": (write_background, lambda path: background.load(path, small_calibration())),
}


@pytest.fixture(scope="module", params=list(KINDS))
def stored(request, tmp_path_factory):
    """Return one stored file of each kind, its bytes, and what reads it."""
    write, read = KINDS[request.param]
    path = write(tmp_path_factory.mktemp(request.param))
    read(path)
    return path, path.read_bytes(), read


def damages(size):
    """Strategy of damage to a file: a bit flipped, a run of bytes overwritten, the end cut off or bytes added."""
    place = st.integers(0, size - 1)
    run = st.binary(min_size=1, max_size=600)
    return st.one_of(
        st.tuples(st.just("flip"), place, st.integers(0, 7)),
        st.tuples(st.just("run"), place, run),
        st.tuples(st.just("cut"), place, st.none()),
        st.tuples(st.just("more"), place, run),
    )


def damaged(content, damage):
    kind, place, value = damage
    changed = bytearray(content)
    if kind == "flip":
        changed[place] ^= 1 << value
    elif kind == "run":
        changed[place : place + len(value)] = value[: len(content) - place]
    elif kind == "cut":
        del changed[place:]
    else:
        changed += value
    return bytes(changed)


@FEWER
@given(data=st.data())
def test_every_damage_to_a_sealed_file_is_noticed(stored, data):
    path, content, read = stored
    changed = damaged(content, data.draw(damages(len(content))))
    path.write_bytes(changed)
    try:
        if changed == content:
            read(path)
            return
        with pytest.raises(DamagedFile, match=path.name):
            read(path)
    finally:
        path.write_bytes(content)


def test_every_array_has_a_checksum_of_its_own(stored):
    """Other programs that read the file notice damage too."""
    path, _, _ = stored
    arrays = []
    with h5py.File(path, "r") as file:
        file.visititems(lambda name, item: arrays.append(item) if isinstance(item, h5py.Dataset) else None)
        numbers = [item for item in arrays if item.shape and item.dtype.kind in "fiub"]
        assert numbers and all(item.fletcher32 for item in numbers)


def test_a_seal_is_stable_and_the_last_thing_in_a_file(stored):
    path, content, read = stored
    hdf5.seal(path)
    assert path.read_bytes() == content
    with h5py.File(path, "r+") as file:
        file.attrs["more"] = 1
    with pytest.raises(DamagedFile, match="has no seal"):
        read(path)
    path.write_bytes(content)


def test_a_file_is_verified_once_and_again_after_it_changed(tmp_path, monkeypatch):
    path, read = write_vectors(tmp_path), []
    monkeypatch.setattr(hdf5, "check_structure", lambda file, size: read.append(file.filename))
    monkeypatch.setattr(hdf5, "SETTLED_S", 0.0)
    for _ in range(3):
        hdf5.verify(path)
    assert len(read) == 1
    content, times = path.read_bytes(), path.stat()
    path.write_bytes(content[:100] + b"x" + content[101:])
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))  # as a copy that keeps times
    with pytest.raises(DamagedFile, match="digest differs"):
        hdf5.verify(path)


# -- structure ---------------------------------------------------------------------------------------------------------


def external_link(file):
    file["u2"] = h5py.ExternalLink("/etc/hostname", "/u")


def soft_link(file):
    file["u2"] = h5py.SoftLink("/u2")


def circle(file):
    file["group/again"] = file.create_group("group")


def shared(file):
    file["u2"] = file["u"]


def external_storage(file):
    file.create_dataset("u2", (10,), "f8", external=[("/etc/passwd", 0, 80)])


def virtual(file):
    layout = h5py.VirtualLayout((10,), "f8")
    layout[:] = h5py.VirtualSource("other.nc", "u", (10,))
    file.create_virtual_dataset("u2", layout)


def sparse(file):
    file.create_dataset("u2", (20_000, 1000, 1000), "f8", chunks=(1, 1000, 1000), compression="gzip")


def sparse_and_plain(file):
    file.create_dataset("u2", (20_000, 1000, 1000), "f8")


def partly_stored(file):
    file.create_dataset("u2", (100, 100), "f8", chunks=(10, 100), compression="gzip")[:10] = 1.0


def other_filter(file):
    file.create_dataset("u2", data=np.zeros(100), compression="lzf")


def named_type(file):
    file["kind"] = np.dtype("f8")


def many(file):
    for number in range(hdf5_structure.LARGEST_COUNT + 1):
        file.create_group(f"group/{number}")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (external_link, "link to another place"),
        (soft_link, "link to another place"),
        (circle, "linked twice"),
        (shared, "linked twice"),
        (external_storage, "in other files"),
        (virtual, "in other files"),
        (sparse, "0 of 20000 chunks"),
        (sparse_and_plain, "160000000000 bytes are declared, 0 are stored"),
        (partly_stored, "1 of 10 chunks"),
        (other_filter, "unknown filter"),
        (named_type, "neither a group nor an array"),
        (many, "more than 10000 objects"),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_what_no_result_holds_is_refused_before_it_is_read(tmp_path, change, words):
    path = write_vectors(tmp_path)
    rewrite(path, change, sealed=True)
    with pytest.raises(DamagedFile, match=words):
        netcdf.read_vectors(path)


@pytest.mark.parametrize("kind", list(KINDS))
@pytest.mark.parametrize("place", ["pipe", "folder", "device", "dead link", "empty", "text"])
def test_what_is_no_file_is_refused_at_once(tmp_path, kind, place):
    path, read = tmp_path / "pair_0000.nc", KINDS[kind][1]
    if place == "pipe":
        os.mkfifo(path)
    elif place == "folder":
        path.mkdir()
    elif place == "device":
        path.symlink_to("/dev/zero")
    elif place == "dead link":
        path.symlink_to("nothing")
    else:
        path.write_bytes(b"" if place == "empty" else b"no HDF5" * 100)
    start = time.monotonic()
    with pytest.raises(DamagedFile, match=r"pair_0000\.nc"):
        read(path)
    assert time.monotonic() - start < QUICK_S


def test_the_error_travels_between_processes():
    import pickle

    error = pickle.loads(pickle.dumps(DamagedFile("x.nc", "why", "Do this")))
    assert str(error) == str(DamagedFile("x.nc", "why", "Do this")) and error.reason == "why"
