"""Chunks of HDF5 datasets: filters that cameras write, images that were never written, chunks that inflate."""

import tracemalloc
import zlib
from pathlib import Path

import h5py
import imagecodecs
import numpy as np
import pytest

from lfpiv import InputError
from lfpiv.experiment import images
from lfpiv.experiment.opening import read_experiment
from lfpiv.experiment.recorded import missing

FRAMES = np.random.default_rng(3).integers(0, 4096, (3, 21, 35), np.uint16)
BITSHUFFLE_BLOCK = 128
"""Pixels in a block of the filter bitshuffle."""
MEMORY = 20 << 20
"""Largest memory that an inflating chunk may take [byte]."""


def bitshuffled(data, encode):
    """Return a chunk of the filter bitshuffle, from its description: blocks, then what fills no group of eight."""
    pixels = np.frombuffer(data, np.uint16)
    whole = len(pixels) // 8 * 8
    found = len(data).to_bytes(8, "big") + (2 * BITSHUFFLE_BLOCK).to_bytes(4, "big")
    for start in range(0, whole, BITSHUFFLE_BLOCK):
        block = encode(
            imagecodecs.bitshuffle_encode(pixels[start : min(start + BITSHUFFLE_BLOCK, whole)].tobytes(), itemsize=2)
        )
        found += len(block).to_bytes(4, "big") + block
    return found + pixels[whole:].tobytes()


FILTERS = {
    "LZ4": (32004, (0,), imagecodecs.lz4h5_encode),
    "Zstd": (32015, (3,), imagecodecs.zstd_encode),
    "Blosc": (32001, (2, 2, 2, 0, 5, 1, 1), lambda data: imagecodecs.blosc_encode(data, typesize=2, shuffle=1)),
    "bitshuffle, LZ4": (32008, (0, 4, 2, 0, 2), lambda data: bitshuffled(data, imagecodecs.lz4_encode)),
    "bitshuffle, Zstd": (32008, (0, 4, 2, 0, 3, 3), lambda data: bitshuffled(data, imagecodecs.zstd_encode)),
}


def write(path, number, values, encode, chunk=(1, 21, 35)):
    """Write images behind a filter that h5py itself need not know."""
    with h5py.File(path, "w") as file:
        settings = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        settings.set_chunk(chunk)
        settings.set_filter(number, h5py.h5z.FLAG_OPTIONAL, values)
        space = h5py.h5s.create_simple(FRAMES.shape)
        made = h5py.h5d.create(file.id, b"images", h5py.h5t.NATIVE_UINT16, space, settings)
        for at, frame in enumerate(FRAMES):
            for row in range(0, 21, chunk[1]):
                part = np.zeros(chunk[1:], np.uint16)
                cut = frame[row : row + chunk[1]]
                part[: len(cut)] = cut
                made.write_direct_chunk((at, row, 0), bytes(encode(part.tobytes())))


def read(path, number):
    return images.read_image(Path(f"{path}#images[{number}]"), "test")


def refuse(path, number, words):
    for call in (images.read_header, images.read_image):
        with pytest.raises(InputError, match=words):
            call(Path(f"{path}#images[{number}]"), "test")


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("chunk", [(1, 21, 35), (1, 8, 35)], ids=str)
def test_images_behind_filters_are_read(tmp_path, name, chunk):
    write(tmp_path / "run.h5", *FILTERS[name], chunk)
    for number, frame in enumerate(FRAMES):
        np.testing.assert_array_equal(read(tmp_path / "run.h5", number), frame)


@pytest.mark.parametrize(
    "options",
    [
        {"compression": "gzip"},
        {"compression": "gzip", "shuffle": True, "fletcher32": True},
        {"compression": "lzf", "chunks": (2, 10, 20)},
        {"shuffle": True, "chunks": (1, 21, 10)},
        {"scaleoffset": 0},
        {"fletcher32": True, "chunks": (3, 4, 4)},
        {"maxshape": (None, 21, 35), "chunks": (1, 21, 35)},
    ],
    ids=str,
)
@pytest.mark.parametrize("kind", ["<u2", ">u2", "f4"])
def test_chunks_are_read_as_hdf5_reads_them(tmp_path, options, kind):
    if "scaleoffset" in options and kind == "f4":
        pytest.skip("scale-offset with loss")
    with h5py.File(tmp_path / "run.h5", "w") as file:
        file.create_dataset("images", data=FRAMES.astype(kind), **options)
    for number, frame in enumerate(FRAMES):
        np.testing.assert_array_equal(read(tmp_path / "run.h5", number), frame)


def test_a_chunk_that_szip_would_make_larger_is_stored_plain(tmp_path):
    noise = np.random.default_rng(8).integers(0, 256, FRAMES.shape, np.uint8)
    with h5py.File(tmp_path / "run.h5", "w") as file:
        file.create_dataset("images", data=noise, chunks=(1, 21, 35), compression="szip")
    np.testing.assert_array_equal(read(tmp_path / "run.h5", 1), noise[1])


def test_filters_of_hdf5plugin_are_read(tmp_path):
    plugin = pytest.importorskip("hdf5plugin")
    for number, options in enumerate(
        (plugin.Bitshuffle(), plugin.Bitshuffle(cname="none"), plugin.LZ4(), plugin.Zstd(), plugin.Blosc("lz4hc"))
    ):
        with h5py.File(tmp_path / f"{number}.h5", "w") as file:
            file.create_dataset("images", data=FRAMES, chunks=(1, 21, 35), **options)
        np.testing.assert_array_equal(read(tmp_path / f"{number}.h5", 2), FRAMES[2])


def test_another_filter_is_named_before_any_work(tmp_path):
    write(tmp_path / "run.h5", 32099, (0,), lambda data: data)
    refuse(tmp_path / "run.h5", 1, "behind the filter 32099.*not read; write the images with gzip")


@pytest.mark.parametrize("chunk", [(1, 21, 35), (1, 8, 16)], ids=str)
def test_images_that_were_never_written_are_missing(tmp_path, chunk):
    with h5py.File(tmp_path / "run.h5", "w") as file:
        made = file.create_dataset("images", (10, 21, 35), "u2", chunks=chunk)
        made[:4], made[6], made[8, :5] = 7, 9, 3
    assert read(tmp_path / "run.h5", 3).mean() == 7 and read(tmp_path / "run.h5", 6).mean() == 9
    for number in (4, 5, 7, 9):
        refuse(tmp_path / "run.h5", number, f"image {number} of the dataset images was never written")
    if chunk != (1, 21, 35):
        refuse(tmp_path / "run.h5", 8, "image 8 of the dataset images was never written")


def test_a_recording_cut_short_is_counted(tiny_experiment):
    folder, shapes = tiny_experiment.parent, {"left": (48, 64), "right": (56, 40)}
    for name, shape in shapes.items():
        with h5py.File(folder / f"{name}.h5", "w") as file:
            file.create_dataset("images", (20, *shape), "u2", chunks=(1, *shape))[:12] = 7
    text = tiny_experiment.read_text("utf-8").replace("pairs = 2", "pairs = 10")
    tiny_experiment.write_text(
        text.replace("particles/{camera}/{pair:04d}{frame}.tif", "{camera}.h5#images[{image}]"), "utf-8"
    )
    found = missing(read_experiment(tiny_experiment))
    assert found is not None and found.complete == 6 and found.end == range(6, 10)


@pytest.mark.parametrize("name", ["deflate", *FILTERS])
def test_a_chunk_that_inflates_is_refused_in_little_memory(tmp_path, name):
    size = 60 << 20
    if name == "deflate":
        number, values, encode = 1, (6,), zlib.compress
    else:
        number, values, encode = FILTERS[name]
    stored = bytes(encode(bytes(size))) if "bitshuffle" not in name else size.to_bytes(8, "big") + bytes(4000)
    write(tmp_path / "run.h5", number, values, lambda data: stored)
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match="truncated or damaged"):
            read(tmp_path / "run.h5", 1)
        assert tracemalloc.get_traced_memory()[1] < MEMORY
    finally:
        tracemalloc.stop()
