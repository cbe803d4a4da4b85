"""Damaged stacks and recordings, drawn at random: each gives an image or an `InputError`, and takes little memory."""

import re
import tracemalloc
from pathlib import Path

import h5py
import imagecodecs
import numpy as np
import pytest
import tifffile
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.recordings import write_b16, write_cine, write_mraw

from lfpiv import InputError
from lfpiv.experiment import images
from lfpiv.experiment.opening import check_pairs, read_experiment
from lfpiv.settings.rig import RawImages

SHAPE = (12, 16)
FRAMES = np.random.default_rng(4).integers(1, 4096, (3, *SHAPE), np.uint16)
LAYOUT = RawImages(shape=SHAPE, dtype="uint16", header_bytes=16)
MEMORY = 200 << 20
"""Largest memory that a damaged file may take: what may be decoded from a few bytes, as pixels and as floats [byte]."""
EXTREMES = (2**32 - 1, 2**31 - 1, 2**31, 100_000, 65_535, 0)
"""Numbers that stand for absurd sizes, counts and places."""


def write_tiff(path, **options):
    with tifffile.TiffWriter(path, bigtiff=options.pop("bigtiff", False)) as tiff:
        for frame in FRAMES:
            tiff.write(frame, contiguous=False, metadata=None, photometric="minisblack", **options)


def write_hdf5(path, libver=None, **options):
    with h5py.File(path, "w", libver=libver) as file:
        file.create_dataset("images", data=FRAMES, **options)


WRITERS = {
    "plain.tif": write_tiff,
    "big.tif": lambda path: write_tiff(path, bigtiff=True, compression="zlib"),
    "strips.tif": lambda path: write_tiff(path, compression="lzw", rowsperstrip=5),
    "one.png": lambda path: path.write_bytes(imagecodecs.png_encode(FRAMES[1])),
    "plain.h5": write_hdf5,
    "chunks.h5": lambda path: write_hdf5(path, libver="latest", chunks=(1, *SHAPE), compression="gzip"),
    "bits16.cine": lambda path: write_cine(path, FRAMES),
    "bits12.cine": lambda path: write_cine(path, FRAMES, 12),
    "bits10.cine": lambda path: write_cine(path, FRAMES >> 2, 10),
    "run.mraw": lambda path: write_mraw(path, FRAMES),
    "one.b16": lambda path: write_b16(path, FRAMES[1]),
    "run.raw": lambda path: path.write_bytes(bytes(16) + FRAMES.tobytes()),
}


def read(path):
    part = "" if path.name.startswith("one") else "#1"
    return images.read_image(Path(f"{path}{part}"), "test", raw=LAYOUT)


@st.composite
def damages(draw, data):
    """Draw a damaged form of a file: cut, with a bit flipped, or with an extreme number; often near its beginning."""
    kind = draw(st.sampled_from(["cut", "flip", "number"]))
    last = len(data) - 1
    at = draw(st.integers(0, min(last, 600)) | st.integers(0, last) | st.integers(max(0, last - 300), last))
    if kind == "cut":
        return data[:at]
    damaged = bytearray(data)
    if kind == "flip":
        damaged[at] ^= 1 << draw(st.integers(0, 7))
    else:
        damaged[at : at + 4] = draw(st.sampled_from(EXTREMES)).to_bytes(4, "little")
    return bytes(damaged)


@pytest.mark.parametrize("name", WRITERS)
def test_a_damaged_file_gives_an_image_or_is_refused(tmp_path, name):
    path = tmp_path / name
    WRITERS[name](path)
    whole, right = path.read_bytes(), read(path)

    @settings(max_examples=60, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck))
    @given(damages(whole))
    def check(damaged):
        path.write_bytes(damaged)
        tracemalloc.start()
        try:
            found = read(path)
        except InputError as error:
            assert str(path) in str(error) and "\n" not in str(error)
            return
        finally:
            peak = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
            assert peak < MEMORY
        assert found.shape == right.shape and np.isfinite(found).all()
        if len(damaged) < len(whole):
            np.testing.assert_array_equal(found, right)  # what is left of a cut file is right

    check()


@pytest.mark.parametrize("name", ["run.mraw"])
def test_a_damaged_text_header_gives_an_image_or_is_refused(tmp_path, name):
    path, beside = tmp_path / name, tmp_path / "run.cih"
    WRITERS[name](path)
    text = beside.read_bytes()

    @settings(max_examples=100, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck))
    @given(damages(text) | st.binary(max_size=200))
    def check(damaged):
        beside.write_bytes(damaged)
        try:
            assert read(path).ndim == 2
        except InputError as error:
            assert str(path) in str(error)

    check()


@pytest.mark.parametrize("suffix", ["cine", "b16", "mraw", "png", "tif"])
def test_absurd_sizes_are_refused_before_memory_is_taken(tmp_path, suffix):
    path, size = tmp_path / f"one.{suffix}", 100_000
    if suffix == "cine":
        write_cine(path, FRAMES[:1])
        data = bytearray(path.read_bytes())
        data[48:56] = size.to_bytes(4, "little") * 2
    elif suffix == "b16":
        write_b16(path, FRAMES[0])
        data = bytearray(path.read_bytes())
        data[12:20] = size.to_bytes(4, "little") * 2
    elif suffix == "mraw":
        write_mraw(path, FRAMES[:1], Image_Width=size, Image_Height=size)
        data = bytearray(path.read_bytes())
    elif suffix == "png":
        data = bytearray(imagecodecs.png_encode(FRAMES[0]))
        data[16:24] = size.to_bytes(4, "big") * 2
    else:
        pages = tifffile.TiffWriter(path)
        pages.write(np.zeros((1, 1), np.uint16), compression="zlib", metadata=None)
        pages.close()
        data = bytearray(path.read_bytes())
        with tifffile.TiffFile(path) as tiff:
            for tag in ("ImageWidth", "ImageLength", "RowsPerStrip"):
                at = tiff.pages[0].tags[tag].valueoffset
                data[at - 6 : at + 4] = b"\x04\x00\x01\x00\x00\x00" + size.to_bytes(4, "little")
    path.write_bytes(data)
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=r"one\."):
            read(path)
        assert tracemalloc.get_traced_memory()[1] < 20 << 20
    finally:
        tracemalloc.stop()


def test_a_bad_frame_is_one_bad_pair(tiny_experiment):
    """A page that does not decode, is cut off or lies beyond the end spoils the pairs that need it."""
    folder, rng = tiny_experiment.parent, np.random.default_rng(6)
    for name, shape in (("left", (48, 64)), ("right", (56, 40))):
        with tifffile.TiffWriter(folder / f"{name}.tif") as tiff:
            for frame in rng.integers(0, 4096, (8, *shape), np.uint16):
                tiff.write(frame, contiguous=False, metadata=None, compression="zlib")
    with tifffile.TiffFile(folder / "left.tif") as tiff:
        start = tiff.pages[3].dataoffsets[0]
    left, right = (bytearray((folder / f"{name}.tif").read_bytes()) for name in ("left", "right"))
    left[start : start + 40] = bytes(40)
    (folder / "left.tif").write_bytes(left)
    (folder / "right.tif").write_bytes(right[:-100])
    text = tiny_experiment.read_text("utf-8").replace("pairs = 2", "pairs = 5")
    text = text.replace("particles/{camera}/{pair:04d}{frame}.tif", "{camera}.tif#{image}")
    tiny_experiment.write_text(text, "utf-8")
    bad = dict(check_pairs(read_experiment(tiny_experiment), range(5)))
    for pair, words in ((1, "left.tif#3 .*damaged"), (3, "right.tif#7 .*damaged"), (4, "left.tif#8 .*none of them #8")):
        assert re.search(words, bad.pop(pair))
    assert not bad
