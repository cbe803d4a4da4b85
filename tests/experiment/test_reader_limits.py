"""Sizes that files declare and sizes that they grow to are refused in little memory and time; layouts are stated."""

import struct
import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import pytest
import tifffile
from support.recordings import write_mraw

from lfpiv import InputError
from lfpiv.experiment import images
from lfpiv.settings.rig import RawImages

MEMORY = 20 << 20
"""Largest memory that a refused file may take [byte]."""
FRAMES = np.random.default_rng(3).integers(0, 4096, (4, 12, 20), np.uint16)


def refuse(path, words, **settings):
    """Assert that an image is refused in one line, by header and pixels, in little memory."""
    for call in (images.read_header, images.read_image):
        tracemalloc.start()
        try:
            with pytest.raises(InputError, match=words) as caught:
                call(Path(path), "test", **settings)
            assert tracemalloc.get_traced_memory()[1] < MEMORY
        finally:
            tracemalloc.stop()
        assert "\n" not in str(caught.value) and len(str(caught.value)) < 600


def write_strips(path, edge, places, data):
    """Write a TIFF of edge x edge pixels of 8 bits whose strips, compressed by deflate, lie at given places."""
    offsets_at = 8 + 2 + 12 * 9 + 4
    counts_at = offsets_at + 4 * len(places)
    data_at = counts_at + 4 * len(places)
    entries = [(256, 4, 1, edge), (257, 4, 1, edge), (258, 3, 1, 8), (259, 3, 1, 8), (262, 3, 1, 1), (277, 3, 1, 1)]
    entries += [(273, 4, len(places), offsets_at), (278, 4, 1, edge // len(places)), (279, 4, len(places), counts_at)]
    rows = b"".join(struct.pack("<HHII", *entry) for entry in sorted(entries))
    starts = [data_at + start for start, _ in places]
    lists = struct.pack(f"<{2 * len(places)}I", *starts, *(length for _, length in places))
    path.write_bytes(b"II*\0" + struct.pack("<IH", 8, len(entries)) + rows + bytes(4) + lists + data)


@pytest.mark.parametrize("shift", [0, 1], ids=["same", "overlapping"])
def test_strips_that_share_bytes_are_refused(tmp_path, shift):
    edge, strips = 12_000, 120
    data = zlib.compress(bytes(edge * edge // strips), 9)
    places = [(shift * number, len(data)) for number in range(strips)]
    write_strips(tmp_path / "bomb.tif", edge, places, data + bytes(strips))
    refuse(tmp_path / "bomb.tif", "share the bytes")


def test_strips_in_any_order_are_read(tmp_path):
    image = np.random.default_rng(1).integers(0, 256, (8, 8), np.uint8)
    parts = [zlib.compress(image[row : row + 2].tobytes()) for row in range(0, 8, 2)]
    starts, at = [0] * 4, 0
    for number in (2, 0, 3, 1):
        starts[number], at = at, at + len(parts[number])
    places = [(start, len(part)) for start, part in zip(starts, parts, strict=True)]
    write_strips(tmp_path / "a.tif", 8, places, b"".join(parts[number] for number in (2, 0, 3, 1)))
    np.testing.assert_array_equal(images.read_image(tmp_path / "a.tif", "test"), image)


@pytest.mark.parametrize("shape", [(100_000, 100_000), (30_000, 20_000)], ids=str)
def test_a_huge_file_without_header_is_refused(tmp_path, shape):
    with (tmp_path / "run.raw").open("wb") as file:
        file.truncate(shape[0] * shape[1])  # takes no room on the disk
    layout = RawImages(shape=shape, dtype="uint8")
    refuse(tmp_path / "run.raw", r"declares .* pixels of at most .*\. Correct its shape", raw=layout)


def test_bytes_behind_the_pixels_are_stated(tmp_path):
    rng = np.random.default_rng(0)
    blocks = b"".join(b"head" + frame.tobytes() + rng.bytes(60) for frame in FRAMES)
    (tmp_path / "run.bin").write_bytes(bytes(100) + blocks)
    layout = {"shape": (12, 20), "dtype": "uint16", "header_bytes": 100, "frame_header_bytes": 4}
    for number, frame in enumerate(FRAMES):
        path = tmp_path / f"run.bin#{number}"
        found = images.read_image(path, "test", raw=RawImages(**layout, frame_footer_bytes=60))
        np.testing.assert_array_equal(found, frame)
    refuse(tmp_path / "run.bin#0", "multiple of 484 bytes", raw=RawImages(**layout))


@pytest.mark.parametrize("bits", [8, 12, 16])
@pytest.mark.parametrize("header", ["cih", "cihx"])
def test_the_colour_type_raw_is_that_of_the_camera(tmp_path, bits, header):
    """Photron's viewer states it for packed pixels of monochrome models too."""
    path, stored = tmp_path / "run.mraw", FRAMES >> (4 if bits == 8 else 0)
    write_mraw(path, stored, bits, header=header)
    beside = path.with_suffix(f".{header}")
    text = beside.read_bytes().replace(b"<type>Mono", b"<type>Raw").replace(b"Color Type : Mono", b"Color Type : Raw")
    for model, words in {
        "SA-Z type 2100K-M-64GB": "",
        "NOVA S12 type 1000K-M": "",
        "SA-Z type 2100K-C-64GB": "colour camera",
        "MINI": "neither M, monochrome, nor C",
    }.items():
        named = text.replace(b"FASTCAM SA-Z", b"FASTCAM " + model.encode()).replace(
            b"<deviceName>FASTCAM<", b"<deviceName>FASTCAM " + model.encode() + b"<"
        )
        beside.write_bytes(named)
        if words:
            refuse(tmp_path / "run.mraw#1", words)
        else:
            np.testing.assert_array_equal(images.read_image(tmp_path / "run.mraw#1", "test"), stored[1])


def test_open_tags_take_time_in_proportion(tmp_path):
    write_mraw(tmp_path / "run.mraw", FRAMES, header="cihx")
    tags = b"<colorInfo>" * 40_000 + b"<type>" * 40_000  # minutes where each tag looks for the end of the text
    (tmp_path / "run.cihx").write_bytes(tags)
    refuse(tmp_path / "run.mraw#0", "its header has Image Height")


@pytest.mark.parametrize("count", [3, 4])
def test_a_stack_in_one_page_is_named(tmp_path, count):
    tifffile.imwrite(tmp_path / "stack.tif", FRAMES[:count], photometric="rgb", planarconfig="separate")
    refuse(tmp_path / "stack.tif", "or a stack that was saved as one page")


def test_a_compression_with_loss_is_named(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", FRAMES[0].astype(np.uint8), compression="jpeg", photometric="minisblack")
    refuse(tmp_path / "a.tif", "compressed by JPEG; expected one of none, LZW")
