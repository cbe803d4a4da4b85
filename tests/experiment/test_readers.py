"""Stacks and cameras' own files: images by number and name, refusals, what is kept between images."""

import os
import socket
import struct
import subprocess
import sys
import time
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import h5py
import imagecodecs
import numpy as np
import pytest
import tifffile
from support.recordings import pack_12, write_b16, write_cine, write_mraw

from lfpiv import InputError
from lfpiv.experiment import images
from lfpiv.experiment.readers.source import ImagePath, split
from lfpiv.results import stamps
from lfpiv.settings.rig import RawImages

COUNT, ROWS, COLUMNS = 5, 12, 20
LABEL = "particles.images, camera 'left'"
LINEAR_COUNTS = {0: 2, 1: 5, 64: 64, 160: 156, 512: 998, 1000: 3947, 1014: 4064, 1023: 4095}
"""Counts of some packed 10-bit codes, from the table of "Cine File Format"."""
ORIENTATION = 274
"""Number of the TIFF tag."""


@pytest.fixture
def frames():
    return np.random.default_rng(3).integers(0, 4096, (COUNT, ROWS, COLUMNS), np.uint16)


def write_stack(path, frames, **options):
    file = {name: options.pop(name) for name in ("bigtiff", "byteorder") if name in options}
    with tifffile.TiffWriter(path, **file) as tiff:
        for frame in frames:
            tiff.write(frame, contiguous=False, metadata=None, photometric="minisblack", **options)


def read(path, part="", **settings):
    return images.read_image(Path(f"{path}{part}"), LABEL, **settings)


def refuse(path, part, words, **settings):
    """Assert that header and pixels of an image are refused in one line that names the file."""
    for call in (images.read_header, images.read_image):
        with pytest.raises(InputError, match=words) as caught:
            call(Path(f"{path}{part}"), LABEL, **settings)
        message = str(caught.value)
        assert str(path) in message and LABEL in message and "\n" not in message and len(message) < 600


def require_numbered(path, frames, **settings):
    """Assert that each image of a stack is the one of its number, that headers agree, and that others are refused."""
    for number in (COUNT - 1, 0, 2, *range(COUNT)):
        np.testing.assert_array_equal(read(path, f"#{number:03d}", **settings), frames[number])
        header = images.read_header(path.with_name(f"{path.name}#{number}"), LABEL, **settings)
        assert header == images.Header((ROWS, COLUMNS), frames.dtype.name)
    refuse(path, "", rf"{COUNT} (page|image)s; name one behind the file: #0 to #{COUNT - 1}", **settings)
    refuse(path, f"#{COUNT}", rf"{COUNT} (page|image)s, none of them #{COUNT}; they count from 0", **settings)
    for part in ("#left", "#-1", "#1.0", "#" + "9" * 150, "#٣"):
        refuse(path, part, "by number, counted from 0", **settings)


@pytest.mark.parametrize(
    "options",
    [{}, {"bigtiff": True}, {"byteorder": ">"}, {"compression": "zlib"}, {"compression": "lzw", "rowsperstrip": 5}],
    ids=str,
)
def test_pages_of_a_tiff_are_numbered(tmp_path, frames, options):
    write_stack(tmp_path / "stack.TIF", frames, **options)
    require_numbered(tmp_path / "stack.TIF", frames)


def test_pages_of_packed_12_bits_are_read(tmp_path, frames):
    packed = np.frombuffer(pack_12(frames[0]), np.uint8).reshape(ROWS, -1)
    tifffile.imwrite(tmp_path / "one.tif", packed, metadata=None, photometric="minisblack")
    with tifffile.TiffFile(tmp_path / "one.tif", mode="r+b") as tiff:
        tags = tiff.pages.first.tags
        tags["ImageWidth"].overwrite(COLUMNS)
        tags["BitsPerSample"].overwrite(12)
    np.testing.assert_array_equal(read(tmp_path / "one.tif"), frames[0])


def test_images_behind_the_only_directory_of_a_stack_of_imagej_are_numbered(tmp_path, frames):
    """ImageJ writes so where the stack is larger than 4 GiB."""
    tifffile.imwrite(tmp_path / "stack.tif", frames, imagej=True, truncate=True)
    with tifffile.TiffFile(tmp_path / "stack.tif") as tiff:
        assert len(tiff.pages) == 1
    require_numbered(tmp_path / "stack.tif", frames)
    whole = (tmp_path / "stack.tif").read_bytes()
    (tmp_path / "stack.tif").write_bytes(whole[:-1])
    np.testing.assert_array_equal(read(tmp_path / "stack.tif", f"#{COUNT - 2}"), frames[-2])
    refuse(tmp_path / "stack.tif", f"#{COUNT - 1}", "truncated or damaged")


@pytest.mark.parametrize(
    ("options", "dtype"),
    [
        ({"bits": 16, "RealBPP": 12}, np.uint16),
        ({"bits": 16, "RealBPP": 10, "annotation": b"12 bytes of text"}, np.uint16),
        ({"bits": 16, "version": 0, "top_down": True, "first_image": 0}, np.uint16),
        ({"bits": 8}, np.uint8),
        ({"bits": 12}, np.uint16),
        ({"bits": 16, "Compression": 2}, np.uint16),
    ],
    ids=str,
)
@pytest.mark.parametrize("columns", [COLUMNS, COLUMNS - 2])
def test_images_of_a_cine_are_numbered_from_the_first_one_stored(tmp_path, frames, options, dtype, columns):
    cut = (frames >> (4 if dtype is np.uint8 else 0)).astype(dtype)[:, :, :columns]
    write_cine(tmp_path / "run.cine", cut, **options)
    for number, frame in enumerate(cut):
        np.testing.assert_array_equal(read(tmp_path / "run.cine", f"#{number}"), frame)
    if columns == COLUMNS:
        require_numbered(tmp_path / "run.cine", cut)


@pytest.mark.parametrize("first", [0, 2], ids=["in order", "from the middle on, as a ring of memory holds them"])
def test_a_cine_needs_no_setup_no_times_and_no_order(tmp_path, frames, first):
    count, rows, columns = frames.shape
    images_at = 44 + 40 + 8 * count
    size = 8 + 2 * rows * columns
    data = struct.pack("<2sHHHiIiI", b"CI", 44, 2, 1, 0, count, 0, count)
    data += struct.pack("<IIIQ", 44, 84, 84, 0)
    data += struct.pack("<IiiHHIIiiII", 40, columns, rows, 1, 16, 0, size - 8, 0, 0, 0, 0)
    data += struct.pack(f"<{count}q", *(images_at + (number + first) % count * size for number in range(count)))
    for frame in np.roll(frames, first, axis=0):
        data += struct.pack("<II", 8, size - 8) + frame[::-1].tobytes()
    (tmp_path / "run.cine").write_bytes(data)
    require_numbered(tmp_path / "run.cine", frames)


def test_packed_10_bit_codes_become_linear_counts(tmp_path):
    codes = np.arange(1024, dtype=np.uint16).reshape(1, 32, 32)
    write_cine(tmp_path / "run.cine", codes, 10)
    counts = read(tmp_path / "run.cine").ravel()
    assert {code: counts[code] for code in LINEAR_COUNTS} == LINEAR_COUNTS
    assert np.all(np.diff(counts) >= 0)


def test_a_missing_extra_for_packed_images_is_named(tmp_path, monkeypatch, frames):
    monkeypatch.setitem(sys.modules, "cine_reader", None)  # as if it were not installed
    write_cine(tmp_path / "run.cine", frames >> 2, 10)
    refuse(tmp_path / "run.cine", "#0", r"cine-handler, found none.*pip install 'lfpiv\[phantom\]'")


@pytest.mark.parametrize("header", ["cih", "cihx"])
@pytest.mark.parametrize(("bits", "dtype"), [(16, np.uint16), (12, np.uint16), (8, np.uint8)])
def test_images_of_an_mraw_are_numbered(tmp_path, frames, header, bits, dtype):
    stored = (frames >> (4 if bits == 8 else 0)).astype(dtype)
    write_mraw(tmp_path / "run_C001H001S0001.mraw", stored, bits, header=header)
    require_numbered(tmp_path / "run_C001H001S0001.mraw", stored)


@pytest.mark.parametrize("line", ["{}:{}", "{}\t:\t{}\r"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_the_text_header_of_an_mraw_needs_no_certain_blanks(tmp_path, frames, line, mark):
    write_mraw(tmp_path / "run.mraw", frames)
    entries = {"Total Frame": COUNT, "Image Width": COLUMNS, "Image Height": ROWS, "Color Bit": 16, "Time": "12:30"}
    text = mark + "\n".join(line.format(key, value) for key, value in entries.items())
    (tmp_path / "run.cih").write_bytes(text.encode())
    require_numbered(tmp_path / "run.mraw", frames)


@pytest.mark.parametrize("options", [{}, {"extended": False}, {"comment": b"laser 2"}], ids=str)
def test_a_b16_is_one_image(tmp_path, frames, options):
    write_b16(tmp_path / "a.b16", frames[1], **options)
    for part in ("", "#0"):
        np.testing.assert_array_equal(read(tmp_path / "a.b16", part), frames[1])
    refuse(tmp_path / "a.b16", "#1", "1 image, none of them #1")


def test_a_file_without_header_is_read_as_the_experiment_file_says(tmp_path, frames):
    swapped = frames.astype(">u2")
    parts = b"".join(b"frame header" + frame.tobytes() for frame in swapped)
    (tmp_path / "run.raw").write_bytes(b"head" + parts)
    layout = {"shape": (ROWS, COLUMNS), "dtype": "uint16", "byte_order": "big", "header_bytes": 4}
    require_numbered(tmp_path / "run.raw", frames, raw=RawImages(**layout, frame_header_bytes=12))
    refuse(tmp_path / "run.raw", "#0", r"expected 4 bytes and a multiple of 480.*found 2464", raw=RawImages(**layout))
    refuse(tmp_path / "run.raw", "#0", r"no table raw of its camera.*\[camera\.raw\]")


def test_images_of_hdf5_datasets_are_named(tmp_path, frames):
    path = tmp_path / "run.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("recorded/images", data=frames, chunks=(1, ROWS, COLUMNS), compression="gzip")
        file["times"] = np.arange(COUNT)
        file["recorded/link"] = h5py.SoftLink("images")
        file["link"] = h5py.SoftLink("/recorded/link")
        for number, frame in enumerate(frames):
            file[f"single/{number:05d}"] = frame[::-1]
    for part in ("#recorded/images[3]", "#recorded/images/3", "#/recorded/images[003]", "#3", "#link[3]", "#link/3"):
        np.testing.assert_array_equal(read(path, part), frames[3])
        assert images.read_header(Path(f"{path}{part}"), LABEL) == images.Header((ROWS, COLUMNS), "uint16")
    np.testing.assert_array_equal(read(path, "#single/00003"), frames[3, ::-1])
    for part, words in {
        "": r"5 images; name one behind the file: #recorded/images\[0\] to #recorded/images\[4\]",
        "#5": "5 images in the dataset recorded/images, none of number 5",
        "#recorded/images[5]": "none of number 5",
        "#recorded": "no dataset 'recorded'",
        "#recorded/none[0]": "no dataset",
        "#single/00003[0]": "one image in the dataset single/00003",
        "#single/00009": "no dataset",
        "#times": r"of shape \(5,\)",
        "#" + "x" * 150: "no dataset",
    }.items():
        refuse(path, part, words)


def test_hdf5_files_with_several_datasets_of_images_need_a_name(tmp_path, frames):
    with h5py.File(tmp_path / "run.h5", "w") as file:
        file["left"], file["right"] = frames, frames
    refuse(tmp_path / "run.h5", "#1", r"2 datasets of images \(left, right\); name one behind the file")
    with h5py.File(tmp_path / "none.h5", "w") as file:
        file["times"] = [1.0]
    refuse(tmp_path / "none.h5", "#1", "no datasets of images")


def test_hdf5_pixels_of_other_files_are_refused(tmp_path, frames):
    """Neither links nor storage leave the file, and sizes beyond what is stored are not believed."""
    frames.tofile(tmp_path / "elsewhere.bin")
    os.mkfifo(tmp_path / "pipe.h5")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["images"] = frames
    with h5py.File(tmp_path / "run.h5", "w") as file:
        file["link"] = h5py.ExternalLink("other.h5", "images")
        file["detour"] = h5py.SoftLink("/link")
        file["pipe"] = h5py.ExternalLink("pipe.h5", "images")
        file["turn"], file["round"] = h5py.SoftLink("/round"), h5py.SoftLink("/turn")
        file["dangling"] = h5py.SoftLink("/nowhere")
        outside = [(tmp_path / "elsewhere.bin", 0, frames.nbytes)]
        file.create_dataset("outside", frames.shape, frames.dtype, external=outside)
        layout = h5py.VirtualLayout(frames.shape, frames.dtype)
        layout[:] = h5py.VirtualSource(tmp_path / "other.h5", "images", frames.shape)
        file.create_virtual_dataset("virtual", layout)
        file.create_dataset("sparse", (2, 100_000, 100_000), np.uint16, chunks=(1, 1000, 1000))
        file.create_dataset("wide", (2, 20_000, 20_000), np.uint16, chunks=(1, 20_000, 20_000))
        file.create_dataset("empty", (2, ROWS, COLUMNS), np.uint16)
        file["compound"] = np.zeros((2, ROWS, COLUMNS), [("a", "u2"), ("b", "u2")])
        file["complex"] = np.zeros((2, ROWS, COLUMNS), complex)
    for name, words in {
        "link": "a link into another file",
        "detour": "a link into another file",
        "pipe": "a link into another file",
        "turn": "links on the way",
        "dangling": "no dataset",
        "outside": "pixels are in another file",
        "virtual": "pixels are in another file",
        "sparse": "declares 100000 x 100000 pixels",
        "wide": "0 stored bytes cannot hold",
        "empty": "has no pixels",
        "compound": "raw grey values",
        "complex": "raw grey values",
    }.items():
        refuse(tmp_path / "run.h5", f"#{name}[1]", words)


def test_what_is_no_grey_image_of_a_recording_is_refused(tmp_path, frames):
    write_cine(tmp_path / "bayer.cine", frames, 16, Compression=2, CFA=3)
    write_cine(tmp_path / "jpeg.cine", frames, 16, Compression=1)
    write_mraw(tmp_path / "colour.mraw", frames, 16, Color_Type="Color")
    write_mraw(tmp_path / "tiff.mraw", frames, 16, File_Format="TIFF")
    write_mraw(tmp_path / "bare.mraw", frames)
    (tmp_path / "bare.cih").unlink()
    write_stack(tmp_path / "mixed.tif", frames[:1])
    tifffile.imwrite(tmp_path / "mixed.tif", np.zeros((ROWS, COLUMNS, 3), np.uint8), append=True, photometric="rgb")
    for name, words in {
        "bayer.cine": "colour filter",
        "jpeg.cine": "compressed",
        "colour.mraw": "Color pixels of 16 bits",
        "tiff.mraw": "saved as tiff",
        "bare.mraw": r"bare\.cih or \.cihx, found none",
        "mixed.tif": "such as a colour image",
    }.items():
        refuse(tmp_path / name, "#1", words)
    np.testing.assert_array_equal(read(tmp_path / "mixed.tif", "#0"), frames[0])


def test_a_truncated_recording_loses_its_last_images_only(tmp_path, frames):
    write_cine(tmp_path / "run.cine", frames)
    write_mraw(tmp_path / "run.mraw", frames)
    write_stack(tmp_path / "run.tif", frames)
    for name in ("run.cine", "run.mraw", "run.tif"):
        whole = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(whole[: -ROWS * COLUMNS * 2])
        np.testing.assert_array_equal(read(tmp_path / name, "#2"), frames[2])
        refuse(tmp_path / name, f"#{COUNT - 1}", "truncated or damaged")


@pytest.mark.parametrize("suffix", [".tif", ".png", ".h5", ".cine", ".mraw", ".b16", ".raw", ".im7"])
def test_pipes_sockets_devices_and_folders_are_refused_unopened(tmp_path, suffix):
    os.mkfifo(tmp_path / f"pipe{suffix}")
    (tmp_path / f"folder{suffix}").mkdir()
    (tmp_path / f"device{suffix}").symlink_to("/dev/zero")
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(os.path.relpath(tmp_path / f"socket{suffix}"))
        for name, words in {"pipe": "pipe", "socket": "pipe", "device": "pipe", "folder": "folder"}.items():
            refuse(tmp_path / f"{name}{suffix}", "#0", f"found a {words}")
    refuse(tmp_path / f"none{suffix}", "#0", "no such file")


def test_a_circle_of_pages_is_refused(tmp_path, frames):
    many = np.broadcast_to(frames[0], (150, ROWS, COLUMNS))
    write_stack(tmp_path / "run.tif", many, bigtiff=True)
    with tifffile.TiffFile(tmp_path / "run.tif") as tiff:
        places = [page.offset for page in tiff.pages]
        tags = len(tiff.pages[-1].tags)
    data = bytearray((tmp_path / "run.tif").read_bytes())
    at = places[-1] + 8 + 20 * tags
    assert data[at : at + 8] == bytes(8)
    data[at : at + 8] = places[3].to_bytes(8, "little")
    (tmp_path / "run.tif").write_bytes(data)
    np.testing.assert_array_equal(read(tmp_path / "run.tif", "#149"), frames[0])
    refuse(tmp_path / "run.tif", "#150", "no page where page 149 says")


def settled(path):
    """Set the time of the last change back, as if the file had been written a minute ago."""
    then = time.time_ns() - 60 * 10**9
    os.utime(path, ns=(then, then))


def test_a_stack_is_opened_once_and_again_when_it_changed(tmp_path, frames, monkeypatch):
    opened = []
    original = tifffile.TiffFile.__init__

    def counted(self, file, *args, **settings):
        opened.append(str(file))
        original(self, file, *args, **settings)

    monkeypatch.setattr(tifffile.TiffFile, "__init__", counted)
    path = tmp_path / "run.tif"
    write_stack(path, frames)
    settled(path)
    for number in range(COUNT):
        np.testing.assert_array_equal(read(path, f"#{number}"), frames[number])
    assert len(opened) == 1
    for order in (frames[::-1], frames):  # written within one tick of the file system's clock, perhaps
        write_stack(path, order)
        np.testing.assert_array_equal(read(path, "#0"), order[0])


def test_files_that_are_no_longer_used_are_closed(tmp_path, frames):
    for number in range(60):
        write_stack(tmp_path / f"{number}.tif", frames)
        with h5py.File(tmp_path / f"{number}.h5", "w") as file:
            file["images"] = frames
        for suffix in (".tif", ".h5"):
            settled(tmp_path / f"{number}{suffix}")
            read(tmp_path / f"{number}{suffix}", "#1")
    assert len(os.listdir("/proc/self/fd")) < 100


@pytest.mark.parametrize("suffix", [".tif", ".h5", ".cine"])
def test_threads_read_from_one_file(tmp_path, frames, suffix):
    path, many = tmp_path / f"run{suffix}", np.concatenate([frames + number for number in range(8)])
    if suffix == ".tif":
        write_stack(path, many, compression="zlib")
    elif suffix == ".cine":
        write_cine(path, many)
    else:
        with h5py.File(path, "w") as file:
            file["images"] = many
    settled(path)

    def work(seed):
        numbers = np.random.default_rng(seed).permutation(len(many))
        return sum(np.array_equal(read(path, f"#{number}"), many[number]) for number in numbers)

    with ThreadPoolExecutor(6) as threads:
        assert list(threads.map(work, range(6))) == [len(many)] * 6


def test_a_mark_counts_only_behind_the_suffix_of_an_image(tmp_path):
    cases = {
        "left/B00001.im7#1.0": ("left/B00001.im7", "1.0"),
        "run#3/stack.tif#12": ("run#3/stack.tif", "12"),
        "left#1.tif": ("left#1.tif", ""),
        "old.tif#1.tif": ("old.tif#1.tif", ""),
        "a.tif#1/b.TIF#2": ("a.tif#1/b.TIF", "2"),
        "x.h5#images/00012": ("x.h5", "images/00012"),
        "x.h5#a#b[1]": ("x.h5", "a#b[1]"),
        "notes.txt#1": ("notes.txt#1", ""),
        "x.cine#": ("x.cine", ""),
    }
    for text, (file, part) in cases.items():
        assert split(tmp_path / text) == ImagePath(tmp_path / file, part), text


def test_an_experiment_of_recordings_opens(tiny_experiment):
    """White, dark and board images may be parts of files too."""
    folder = tiny_experiment.parent
    rng = np.random.default_rng(5)
    shapes = {"left": (48, 64), "right": (56, 40)}
    particles = {name: rng.integers(0, 4096, (4, *shape), np.uint16) for name, shape in shapes.items()}
    boards = {name: rng.integers(0, 4096, (3, *shape), np.uint16) for name, shape in shapes.items()}
    for name in shapes:
        write_cine(folder / f"{name}.cine", particles[name])
        write_stack(folder / f"board_{name}.tif", boards[name])
    dark = rng.integers(0, 20, (2, *shapes["right"]), np.uint16)
    with h5py.File(folder / "run.h5", "w") as file:
        file["dark/images"] = dark
    (folder / "white.raw").write_bytes(boards["left"][2].tobytes())
    text = tiny_experiment.read_text("utf-8")
    for old, new in {
        "board/{camera}/plane_{plane:02d}.tif": "board_{camera}.tif#{plane}",
        "particles/{camera}/{pair:04d}{frame}.tif": "{camera}.cine#{image}",
        "white/right.tif": "board_right.tif#2",
        "white/left.tif": "white.raw",
        "dark/right.tif": "run.h5#dark/images[1]",
        "nominal_angle_deg = 30.0": 'nominal_angle_deg = 30.0\n[camera.raw]\nshape = [48, 64]\ndtype = "uint16"\n',
    }.items():
        assert text.count(old) == 1
        text = text.replace(old, new)
    tiny_experiment.write_text(text, "utf-8")
    from lfpiv import open_experiment

    experiment = open_experiment(tiny_experiment)
    np.testing.assert_array_equal(experiment.white("left"), boards["left"][2])
    np.testing.assert_array_equal(experiment.white("right"), boards["right"][2])
    np.testing.assert_array_equal(experiment.dark("right"), dark[1])
    np.testing.assert_array_equal(experiment.board_image("right", 1), boards["right"][1])
    np.testing.assert_array_equal(experiment.particle_image("left", 1, "b"), particles["left"][3])
    before = stamps.of_calibration(experiment)
    boards["right"][2] += 1
    write_stack(folder / "board_right.tif", boards["right"])
    after = stamps.of_calibration(experiment)
    assert before.hash != after.hash  # the white image is a page of this file


def test_parts_of_files_have_their_own_identity(tmp_path, frames):
    """The grey values of a part count, not the whole file: others in it may change."""
    path = tmp_path / "board.tif"
    write_stack(path, frames)
    parts = [split(path.with_name(f"board.tif#{number}")) for number in range(COUNT)]
    before = [stamps.content_hash([part]) for part in parts]
    assert len(set(before)) == COUNT
    changed = frames.copy()
    changed[1] += 1
    write_stack(path, changed)
    after = [stamps.content_hash([part]) for part in parts]
    assert [old != new for old, new in zip(before, after, strict=True)] == [False, True, False, False, False]


def test_a_png_has_one_image(tmp_path, frames):
    (tmp_path / "a.png").write_bytes(imagecodecs.png_encode(frames[0]))
    np.testing.assert_array_equal(read(tmp_path / "a.png", "#0"), frames[0])
    refuse(tmp_path / "a.png", "#1", "1 image, none of them #1")
    (tmp_path / "filled.png").write_bytes((tmp_path / "a.png").read_bytes() + bytes(100))
    np.testing.assert_array_equal(read(tmp_path / "filled.png"), frames[0])
    (tmp_path / "cut.png").write_bytes((tmp_path / "a.png").read_bytes()[:-12])
    refuse(tmp_path / "cut.png", "", "ends before its end marker")


def test_a_grey_value_of_a_png_may_be_named_as_transparent(tmp_path, frames):
    whole = imagecodecs.png_encode(frames[0])
    content = b"tRNS" + frames[0, 0, :1].astype(">u2").tobytes()
    chunk = struct.pack(">I", 2) + content + struct.pack(">I", zlib.crc32(content))
    (tmp_path / "a.png").write_bytes(whole[:33] + chunk + whole[33:])  # behind signature and header
    np.testing.assert_array_equal(read(tmp_path / "a.png", ""), frames[0])


@pytest.mark.parametrize("turned", range(2, 9))
def test_a_tiff_that_is_shown_turned_is_refused(tmp_path, frames, turned):
    """Programs differ in whether they obey the tag, so nobody knows how the picture lies."""
    tags = [(ORIENTATION, "H", 1, turned, True)]
    tifffile.imwrite(tmp_path / "a.tif", frames[0], photometric="minisblack", extratags=tags)
    refuse(tmp_path / "a.tif", "", f"tag Orientation is {turned}")


def test_a_recording_of_no_images_is_named(tmp_path):
    with h5py.File(tmp_path / "run.h5", "w") as file:
        file.create_dataset("images", (0, ROWS, COLUMNS), np.uint16, maxshape=(None, ROWS, COLUMNS))
    write_mraw(tmp_path / "run.mraw", np.zeros((0, ROWS, COLUMNS), np.uint16))
    for name in ("run.h5", "run.mraw"):
        refuse(tmp_path / name, "", "of no images: nothing was recorded")


def test_a_damaged_tiff_ends_in_one_message(tmp_path):
    """The library logs what it finds, too; without a handler that is printed."""
    (tmp_path / "a.tif").write_bytes(b"II" + struct.pack("<HIHHHIII", 42, 8, 1, 256, 99, 1, 5, 0))
    code = (
        "import sys; from pathlib import Path; from lfpiv.experiment import images; sys.tracebacklimit = 0; "
        "images.read_image(Path(sys.argv[1]), 'test')"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "a.tif")]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    assert len(found.stderr.splitlines()) == 1 and "truncated or damaged" in found.stderr
