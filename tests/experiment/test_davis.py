"""Images of LaVision's DaVis: frames of buffers as images, and refusals."""

import importlib.util
import sys
import types
from pathlib import Path

import numpy as np
import pytest

import lfpiv
from lfpiv.experiment import images
from lfpiv.results import stamps

PAIRS_RECORDED = 50


def frame(pixels, *, mask=None, slope=1.0, offset=0.0, component="PIXEL", planes=1, **attributes):
    """Return a frame with the interface of lvpyio."""
    scales = types.SimpleNamespace(i=types.SimpleNamespace(slope=slope, offset=offset))
    masks = [np.ones(pixels.shape, np.uint8) if mask is None else mask]
    return types.SimpleNamespace(
        components={component: types.SimpleNamespace(planes=[pixels] * planes)},
        scales=scales,
        attributes=attributes,
        masks=masks,
    )


class Buffers(dict):
    """Frames of each file, and the decoded files in order."""

    def __init__(self):
        super().__init__()
        self.decoded = []


@pytest.fixture
def lvpyio(monkeypatch):
    """Replace LaVision's library: buffers by the stem of their file, with a record of the decoded files."""
    buffers = Buffers()

    def read_buffer(path):
        buffers.decoded.append(Path(path).stem)
        if Path(path).stem not in buffers:
            raise RuntimeError("Invalid header.")
        return buffers[Path(path).stem]

    module = types.ModuleType("lvpyio")
    module.read_buffer = read_buffer
    monkeypatch.setitem(sys.modules, "lvpyio", module)
    return buffers


def test_frames_of_a_buffer_are_images(lvpyio, tmp_path):
    rng = np.random.default_rng(0)
    pixels = [rng.integers(0, 4096, (5, 7), np.uint16) for _ in range(4)]
    lvpyio["double"] = [frame(part) for part in pixels]
    lvpyio["single"] = [frame(pixels[3], slope=2.0, offset=-1.0)]
    for name in ("double.im7", "single.imx"):
        (tmp_path / name).write_bytes(b"packed")
    for number, part in enumerate(pixels):
        for path in (tmp_path / f"double.im7#{number}", tmp_path / f"double.im7#{number // 2}.{number % 2}"):
            image = images.read_image(path, "test", flip="both")
            np.testing.assert_array_equal(image, part[::-1, ::-1])
            assert image.dtype == np.float32 and image.flags.c_contiguous
    np.testing.assert_array_equal(images.read_image(tmp_path / "single.imx", "test"), 2.0 * pixels[3] - 1.0)
    assert lvpyio.decoded == ["double", "single"]  # each file once


@pytest.mark.parametrize(
    ("name", "buffer", "words"),
    [
        ("a.im7", [frame(np.ones((2, 3)))] * 4, "4 frames; name one.*#0 to #3"),
        ("a.im7#4", [frame(np.ones((2, 3)))] * 4, "4 frames, none of them #4"),
        ("a.im7#2.0", [frame(np.ones((2, 3)))] * 4, "none of them #2.0"),
        ("a.im7#0.2", [frame(np.ones((2, 3)))] * 4, "exposures 0 and 1"),
        ("a.im7#left", [frame(np.ones((2, 3)))] * 4, "'left'.*by number"),
        ("a.im7", [frame(np.ones((2, 3)), component="U0")], "without pixels"),
        ("a.im7", [frame(np.ones((2, 3)), mask=np.eye(2, 3))], "4 masked pixels"),
        ("a.im7", [frame(np.ones((2, 3)), planes=2)], "2 planes"),
        ("a.im7", [frame(np.ones((2, 3)), RGBFrame="1")], "colour filter"),
        ("a.im7", [frame(np.ones((2, 3), complex))], "complex128"),
        ("a.im7", None, r"damaged one \(Invalid header"),
        ("a.vc7", None, "a file of vectors"),
    ],
)
def test_what_is_no_single_image_is_refused_by_name(lvpyio, tmp_path, name, buffer, words):
    (tmp_path / name.partition("#")[0]).write_bytes(b"packed")
    if buffer is not None:
        lvpyio["a"] = buffer
    with pytest.raises(lfpiv.InputError, match=rf"(?s){name.partition('#')[0]}.*white_image.*{words}"):
        images.read_image(tmp_path / name, "white_image of camera 'left'")


@pytest.mark.parametrize(("name", "words"), [("a.im7#left", "'left'.*by number"), ("a.im7#0.2", "exposures 0 and 1")])
def test_a_frame_that_cannot_be_is_refused_without_decoding(lvpyio, tmp_path, name, words):
    (tmp_path / "a.im7").write_bytes(b"packed")
    with pytest.raises(lfpiv.InputError, match=words):
        images.read_header(tmp_path / name, "white_image of camera 'left'")
    assert lvpyio.decoded == []


def test_a_missing_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "lvpyio", None)  # as if it were not installed
    (tmp_path / "a.im7").touch()
    with pytest.raises(lfpiv.InputError, match=r"a\.im7#0.*lvpyio.*pip install 'lfpiv\[davis\]'"):
        images.read_image(tmp_path / "a.im7#0", "white_image of camera 'left'")


@pytest.fixture
def recorded(lvpyio, tiny_experiment, monkeypatch):
    """Experiment of many pairs, each with both exposures of both cameras in one buffer."""
    monkeypatch.setattr("lfpiv.experiment.opening.DECODED_PIXELS", 4 * 2 * (48 * 64 + 56 * 40))  # four pairs
    rng = np.random.default_rng(1)
    shapes = {"left": (48, 64), "right": (56, 40)}
    for pair in range(PAIRS_RECORDED):
        name = f"B{pair:05d}"
        lvpyio[name] = [frame(rng.integers(0, 4096, shapes[camera], np.uint16)) for camera in shapes for _ in "ab"]
        (tiny_experiment.parent / f"{name}.im7").write_bytes(b"pixels of pair %d" % pair)
    text = tiny_experiment.read_text("utf-8").replace('"left"', '"0"').replace('"right"', '"1"')
    text = text.replace("pairs = 2", f"pairs = {PAIRS_RECORDED}").replace(
        'images = "particles/{camera}/{pair:04d}{frame}.tif"',
        'images = "B{pair:05d}.im7#{camera}.{frame}"\nframes = ["0", "1"]',
    )
    tiny_experiment.write_text(text, "utf-8")
    for number, camera in enumerate(shapes):
        (tiny_experiment.parent / "board" / camera).rename(tiny_experiment.parent / "board" / str(number))
    return tiny_experiment


def test_an_experiment_of_buffers_opens(lvpyio, recorded):
    """Opening decodes the first pairs only. Each frame of a file is one image."""
    experiment = lfpiv.open_experiment(recorded)
    assert lvpyio.decoded == [f"B{pair:05d}" for pair in range(4)]
    last = PAIRS_RECORDED - 1
    np.testing.assert_array_equal(
        experiment.particle_image("1", last, "0"), lvpyio[f"B{last:05d}"][2].components["PIXEL"].planes[0]
    )
    hashes = {stamps.content_hash([image]) for pair in range(2) for image in experiment.pair_images(pair)}
    assert len(hashes) == 8


def test_a_bad_buffer_is_named_at_once_where_it_can_be_and_where_it_is_used_otherwise(lvpyio, recorded):
    lvpyio["B00020"][3] = frame(np.ones((48, 64), np.uint16))  # of the other camera's size
    del lvpyio["B00030"]  # damaged
    experiment = lfpiv.open_experiment(recorded)
    for pair, words in ((20, r"expected \(56, 40\) pixels.*found \(48, 64\)"), (30, "damaged one")):
        with pytest.raises(lfpiv.InputError, match=rf"B000{pair}\.im7#1\.1 \(.*pair {pair}.*{words}"):
            experiment.particle_image("1", pair, "1")
    (recorded.parent / "B00040.im7").write_bytes(b"")
    with pytest.raises(lfpiv.InputError, match=r"B00040\.im7#0\.0.*the file is empty"):
        lfpiv.open_experiment(recorded)
    (recorded.parent / "B00040.im7").unlink()
    with pytest.raises(lfpiv.InputError, match=r"B00040\.im7#0\.0.*no such file"):
        lfpiv.open_experiment(recorded)


@pytest.mark.skipif(importlib.util.find_spec("lvpyio") is None, reason="the extra davis is not installed")
def test_lavisions_own_library_writes_what_is_read(tmp_path):
    import lvpyio

    rng = np.random.default_rng(0)
    pixels = [rng.integers(0, 4096, (48, 64), np.uint16) for _ in range(2)]
    lvpyio.write_buffer(lvpyio.arrays_to_buffer(pixels), str(tmp_path / "B00001.im7"))
    for number, part in enumerate(pixels):
        np.testing.assert_array_equal(images.read_image(tmp_path / f"B00001.im7#{number}", "test"), part)
