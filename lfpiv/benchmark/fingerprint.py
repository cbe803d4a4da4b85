"""Fingerprints of made cases: checksums that show equal bits, and coarse figures that show equality within rounding.

Images of one seed are equal to the last bit on one machine, with any number of threads. Another processor or another
version of a library may round the light of a pixel otherwise. From there on the noise of the image may be another draw:
single pixels then differ, and means over large blocks agree.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.resources
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np
import tifffile
from pydantic import Field

from lfpiv.settings.table import Table
from lfpiv.version import versions

FILE = "fingerprints.json"
"""File of this package with the fingerprints of all cases."""

BLOCKS = 3
"""Blocks of the thumbnail of an image along each side."""

QUANTUM_MM = 1e-9
"""Step to which positions and displacements are rounded before their checksum is taken [mm]."""

TRUTH_TOLERANCE_MM = 1e-6
"""Largest difference of means over particles within rounding [mm]."""

BLOCK_TOLERANCE = (0.3, 0.003)
"""Largest difference of a block's mean within rounding: absolute [count], and relative. Another draw of the noise stays
below a tenth of it; another draw of the particles exceeds it in most blocks."""

Verdict = Literal["identical", "equal within rounding", "differs", "not compared"]


class Fingerprint(Table):
    """Fingerprint of a made case."""

    truth_sha256: str
    """Checksum of the particles' positions and displacements, rounded to `QUANTUM_MM`."""
    truth: dict[str, tuple[float, ...]]
    """Number, mean and root mean square along (x, y, z) of each array of the truth [mm]."""
    images_sha256: str
    """Checksum of names and pixels of all images."""
    images: dict[str, tuple[float, ...]]
    """Means over `BLOCKS` x `BLOCKS` blocks of each image, row by row [count]."""


class Recorded(Fingerprint):
    """Fingerprint of a case in `FILE`."""

    size_mib: float
    """Size of the data set [MiB]."""
    make_s: float
    """Time that making it took on one core [s]."""


class Record(Table):
    """Content of `FILE`."""

    benchmark: str
    """Version of the benchmark."""
    versions: dict[str, str]
    """Versions of the libraries that the fingerprints were made with."""
    cases: dict[str, Recorded] = Field(default_factory=dict)
    """Fingerprint of each case."""


def fingerprint_of(folder: Path, truth: Path) -> Fingerprint:
    """Return the fingerprint of a made case.

    Parameters
    ----------
    folder : Path
        Folder of the data set, with images in TIFF files.
    truth : Path
        Folder of its truth.
    """
    with np.load(truth / "particles.npz") as arrays:
        particles = {name: arrays[name] for name in sorted(arrays.files)}
    images_sha, images = _of_images(folder, truth)
    return Fingerprint(
        truth_sha256=truth_sha256(particles),
        truth={name: _moments(value) for name, value in particles.items() if name.endswith(COMPARED)},
        images_sha256=images_sha,
        images=images,
    )


COMPARED = ("_positions_mm", "_displacement_mm")
"""Ends of the names of the arrays that make up the truth."""


def truth_sha256(particles: Mapping[str, np.ndarray]) -> str:
    """Return the checksum of true positions and displacements, rounded to `QUANTUM_MM`.

    Parameters
    ----------
    particles : mapping
        Arrays as in ``truth/particles.npz``; others than positions and displacements are ignored.
    """
    digest = hashlib.sha256()
    for name in sorted(name for name in particles if name.endswith(COMPARED)):
        rounded = np.rint(np.asarray(particles[name], float) / QUANTUM_MM).astype("<i8")
        digest.update(f"{name} {rounded.shape}\n".encode())
        digest.update(np.ascontiguousarray(rounded).tobytes())
    return digest.hexdigest()


def _moments(values: np.ndarray) -> tuple[float, ...]:
    """Return number of rows, means and root mean squares of the columns."""
    moments = [*values.mean(0), *np.sqrt((values**2).mean(0))]
    return (len(values), *(round(float(value), 7) for value in moments))


def _of_images(folder: Path, truth: Path) -> tuple[str, dict[str, tuple[float, ...]]]:
    """Return checksum and thumbnails of the images below a folder."""
    digest, thumbnails = hashlib.sha256(), {}
    for path in sorted(folder.rglob("*.tif")):
        if truth in path.parents:
            continue
        name, image = path.relative_to(folder).as_posix(), tifffile.imread(path)
        digest.update(f"{name} {image.shape}\n".encode())
        digest.update(image.astype("<u2").tobytes())
        thumbnails[name] = _thumbnail(image)
    return digest.hexdigest(), thumbnails


def _thumbnail(image: np.ndarray) -> tuple[float, ...]:
    """Return means over blocks of an image."""
    rows, columns = (np.linspace(0, size, BLOCKS + 1).astype(int) for size in image.shape)
    blocks = (
        image[rows[i] : rows[i + 1], columns[j] : columns[j + 1]].mean() for i in range(BLOCKS) for j in range(BLOCKS)
    )
    return tuple(round(float(mean), 2) for mean in blocks)


@functools.lru_cache(maxsize=1)
def record() -> Record:
    """Return the fingerprints of this package's cases."""
    text = (importlib.resources.files("lfpiv.benchmark") / FILE).read_text("utf-8")
    return Record.model_validate(json.loads(text))


def compare(found: Fingerprint, known: Fingerprint) -> Verdict:
    """Compare two fingerprints of a case."""
    if (found.truth_sha256, found.images_sha256) == (known.truth_sha256, known.images_sha256):
        return "identical"
    if not (found.truth.keys() == known.truth.keys() and found.images.keys() == known.images.keys()):
        return "differs"
    absolute, relative = BLOCK_TOLERANCE
    same = all(
        np.allclose(found.truth[name], value, rtol=0, atol=TRUTH_TOLERANCE_MM) for name, value in known.truth.items()
    ) and all(
        np.allclose(found.images[name], value, rtol=relative, atol=absolute) for name, value in known.images.items()
    )
    return "equal within rounding" if same else "differs"


def other_versions(known: Mapping[str, str]) -> str:
    """Return what versions differ from known ones, as text; empty if none do."""
    here = versions()
    return ", ".join(
        f"{name} {here.get(name, 'absent')} (recorded with {known.get(name, 'none')})"
        for name in sorted({*here, *known})
        if here.get(name) != known.get(name)
    )
