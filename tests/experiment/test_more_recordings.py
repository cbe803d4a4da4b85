"""StreamPix and uncompressed AVI, and Phantom recordings that are shown mirrored or turned."""

import struct
from pathlib import Path

import numpy as np
import pytest
from support.recordings import write_avi, write_cine, write_seq

from lfpiv import InputError
from lfpiv.experiment import images

FRAMES = np.random.default_rng(3).integers(0, 4096, (5, 12, 21), np.uint16)


def read(path, number):
    header = images.read_header(Path(f"{path}#{number}"), "test")
    found = images.read_image(Path(f"{path}#{number}"), "test")
    assert header == images.Header(found.shape, header.dtype)
    return found


def refuse(path, words, number=0):
    for call in (images.read_header, images.read_image):
        with pytest.raises(InputError, match=words) as caught:
            call(Path(f"{path}#{number}"), "test")
        assert str(path) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("version", [3, 4, 5])
@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
@pytest.mark.parametrize("options", [{}, {"filling": 0}, {"count": 0}, {"bits": 10}], ids=str)
def test_images_of_streampix_are_numbered(tmp_path, version, kind, options):
    frames = (FRAMES >> (4 if kind is np.uint8 else 0)).astype(kind)
    write_seq(tmp_path / "run.SEQ", frames, version=version, **options)
    for number in (4, 0, 2):
        np.testing.assert_array_equal(read(tmp_path / "run.SEQ", number), frames[number])
    refuse(tmp_path / "run.SEQ", "5 images, none of them #5", 5)


def test_what_streampix_stores_otherwise_is_refused(tmp_path):
    for fields, words in (
        ({"form": 101}, "images of format 101"),
        ({"form": 200}, "images of format 200"),
        ({"compression": 1}, "compression 1; save uncompressed grey values"),
        ({"origin": 3}, "first image is number 3 of the file"),
    ):
        write_seq(tmp_path / "run.seq", FRAMES, **fields)
        refuse(tmp_path / "run.seq", words)
    (tmp_path / "run.seq").write_bytes(b"FEED" * 1000)
    refuse(tmp_path / "run.seq", "no header of StreamPix")


def test_a_truncated_seq_loses_its_last_images_only(tmp_path):
    write_seq(tmp_path / "run.seq", FRAMES)
    whole = (tmp_path / "run.seq").read_bytes()
    (tmp_path / "run.seq").write_bytes(whole[:-200])
    np.testing.assert_array_equal(read(tmp_path / "run.seq", 3), FRAMES[3])
    refuse(tmp_path / "run.seq", "truncated or damaged", 4)


@pytest.mark.parametrize(
    "options",
    [{}, {"top_down": True}, {"parts": 3}, {"code": b"Y800", "palette": False}, {"code": b"DIB "}, {"palette": False}],
    ids=str,
)
def test_images_of_an_uncompressed_avi_are_numbered(tmp_path, options):
    frames = (FRAMES >> 4).astype(np.uint8)
    write_avi(tmp_path / "run.avi", frames, **options)
    for number in (4, 0, 2):
        np.testing.assert_array_equal(read(tmp_path / "run.avi", number), frames[number])
    refuse(tmp_path / "run.avi", "5 images, none of them #5", 5)


def test_an_image_that_was_dropped_keeps_its_number(tmp_path):
    """Else all later images would be an instant early beside the other cameras."""
    frames = (FRAMES >> 4).astype(np.uint8)
    write_avi(tmp_path / "run.avi", frames, dropped=(2,))
    for number in (0, 1, 3, 4):
        np.testing.assert_array_equal(read(tmp_path / "run.avi", number), frames[number])
    refuse(tmp_path / "run.avi", "image 2 was dropped", 2)


def test_avi_images_of_16_bits_are_read(tmp_path):
    write_avi(tmp_path / "run.avi", FRAMES, code=b"Y16 ", bits=16, palette=False)
    np.testing.assert_array_equal(read(tmp_path / "run.avi", 3), FRAMES[3])


def test_what_an_avi_stores_otherwise_is_refused(tmp_path):
    frames = (FRAMES >> 4).astype(np.uint8)
    for options, words in (
        ({"code": b"MJPG"}, "compressed by 'MJPG'"),
        ({"bits": 24}, "bitmaps of 24 bits, such as a colour image"),
        ({"palette": bytes(range(256)) * 4}, "such as a colour image"),
    ):
        write_avi(tmp_path / "run.avi", frames, **options)
        refuse(tmp_path / "run.avi", words)
    chunks = (b"JUNK" + bytes(4)) * 20_000
    (tmp_path / "run.avi").write_bytes(b"RIFF" + struct.pack("<I", 4 + len(chunks)) + b"AVI " + chunks)
    refuse(tmp_path / "run.avi", "chunks without an image")


@pytest.mark.parametrize("bits", [8, 16, 12])
@pytest.mark.parametrize("across", [0, 1])
@pytest.mark.parametrize("down", [0, 1, -1])
@pytest.mark.parametrize("turned", [0, 90, -90])
def test_a_cine_is_shown_as_the_makers_software_shows_it(tmp_path, bits, across, down, turned):
    frames = (FRAMES[:, :, :20] >> (4 if bits == 8 else 0)).astype(np.uint8 if bits == 8 else np.uint16)
    write_cine(tmp_path / "run.cine", frames, bits, bFlipH=across, bFlipV=down, Rotate=turned)
    shown = frames[1, :: -1 if down else 1, :: -1 if across else 1]
    np.testing.assert_array_equal(read(tmp_path / "run.cine", 1), np.rot90(shown, turned // 90))
