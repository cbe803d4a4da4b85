"""Hashes of arrays that this machine computed, and figures of them for other machines; both stand in a JSON file.

The last bits depend on the processor's vector units, on the libraries that compile for it, and on BLAS. Where these
differ from the machine that stored the hashes, norms and projections are compared within a tolerance instead.
"""

import hashlib
import json
import platform
from importlib import metadata
from pathlib import Path

import numpy as np
import scipy.linalg  # noqa: F401 - loads the BLAS of SciPy, which is then among those found
import threadpoolctl

FILE = Path(__file__).with_name("stored.json")
LIBRARIES = ("numpy", "scipy", "warp-lang", "taichi", "opencv-python-headless")
OTHER_MACHINE = 0.03
"""Difference of a figure from the stored one, over the array's norm, on another machine. Where rounding decides on a
peak or a subset, whole vectors change."""
OTHER_LIST = 0.05
"""The same for a list of particles: rounds of fitting, removing and adding them amplify rounding. With the BLAS and
the vector units of another processor norms differ by 0.02 and 0.031."""
DIGITS = 6


def machine():
    """Return what the last bits depend on."""
    pools = [pool for pool in threadpoolctl.threadpool_info() if pool["user_api"] == "blas"]
    blas = [pool for pool in pools if {"numpy.libs", "scipy.libs"} & set(Path(pool["filepath"]).parts)]
    return {
        "system": f"{platform.system()} {platform.machine()}",
        "vector units": np.show_config(mode="dicts")["SIMD Extensions"].get("found", []),
        "blas": sorted({f"{pool['internal_api']} {pool['version']} {pool.get('architecture')}" for pool in blas}),
        "libraries": {name: metadata.version(name) for name in LIBRARIES},
    }


def digest(arrays):
    """Return the hash of named arrays."""
    found = hashlib.blake2b(digest_size=8)
    for name, values in sorted(arrays.items()):
        found.update(f"{name} {values.dtype} {values.shape}".encode())
        found.update(np.ascontiguousarray(values).tobytes())
    return found.hexdigest()


def figures(values):
    """Return the norm of an array and its projection on a random direction."""
    flat = np.nan_to_num(np.asarray(values, float)).ravel()
    direction = np.random.default_rng(flat.size).standard_normal(flat.size)
    return [float(f"{figure:.{DIGITS}g}") for figure in (np.linalg.norm(flat), flat @ direction)]


def differences(stored, arrays, listed=False):
    """Yield what differs from the stored figures by more than `OTHER_MACHINE`, of a list by `OTHER_LIST`.

    Where rounding decides on an element of a list, all behind it move, and so does the projection: only norms count.
    """
    for name, values in arrays.items():
        (norm, along), (own_norm, own_along) = stored[name], figures(values)
        moved = abs(own_norm - norm) if listed else max(abs(own_norm - norm), abs(own_along - along))
        if moved > (OTHER_LIST if listed else OTHER_MACHINE) * norm:
            yield f"{name}: norm {own_norm}, projection {own_along}, stored {norm}, {along}"


def as_text(content):
    """Return the content of the file, an entry a line."""
    tables = []
    for name, table in content.items():
        lines = (f" {json.dumps(key)}: {json.dumps(value, sort_keys=True)}" for key, value in sorted(table.items()))
        tables.append(f"{json.dumps(name)}: {{\n" + ",\n".join(lines) + "\n}")
    return "{\n" + ",\n".join(tables) + "\n}\n"


class Stored:
    """The JSON file; with `anew` it is written in place of being compared."""

    def __init__(self, anew=False):
        self.anew, self.content = anew, json.loads(FILE.read_text("utf-8")) if FILE.exists() else {}
        if anew and self.content.get("machine") != machine():
            self.content = {"machine": machine(), "hashes": {}, "figures": {}}

    def check(self, case, loops, arrays, listed=False):
        """Assert that arrays, or columns of a list if `listed`, are those stored for a case and these loops."""
        key = f"{case}, {loops}"
        if self.anew:
            self.content["hashes"][key] = digest(arrays)
            self.content["figures"][key] = {name: figures(values) for name, values in arrays.items()}
            FILE.write_text(as_text(self.content), "utf-8")
        elif self.content["machine"] == machine():
            changed = "; ".join(differences(self.content["figures"][key], arrays)) or "by rounding"
            assert digest(arrays) == self.content["hashes"][key], f"{key}: other bits than stored, {changed}"
            assert changed == "by rounding", f"{key}: these figures are stale, store them anew: {changed}"
        else:
            found = list(differences(self.content["figures"][key], arrays, listed))
            assert not found, f"{key}: {found}"
