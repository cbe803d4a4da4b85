"""The task of a run for its workers: data in a folder that only this user can write, never code.

The task is a JSON file in a folder; weights are arrays beside it. The name of the folder holds the digest of the task,
and the task that of the arrays. The run sends this name to its workers, so a worker refuses what somebody
has changed.
"""

from __future__ import annotations

import dataclasses
import hashlib
import os
import secrets
import shutil
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic_core import PydanticSerializationError

from lfpiv import warn
from lfpiv.errors import InputError, StorageError
from lfpiv.experiment.experiment import Experiment
from lfpiv.files import size_text, writing
from lfpiv.results.folder import Folder
from lfpiv.results.stamps import Inputs
from lfpiv.runs.pair import PairWork
from lfpiv.version import __version__

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera
    from lfpiv.weights.operator import Weights

TASK, INSTANTS, WEIGHTS = "task.json", "instants", "weights"
"""Names of the task and of the volumes in its folder, and of the weights beside that folder."""

DIGEST_CHARACTERS = 32
"""Characters of the task's digest in the name of its folder."""


class Task(BaseModel):
    """Settings of a run for its workers."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    version: str
    experiment: Experiment
    folder: Folder
    inputs: Inputs
    keep_volumes: bool
    refusals: str
    """JSON text of `PairWork.refusals`."""
    vectors: bool
    weights: str | None
    """Digest of the weights; None if no volume has to be reconstructed."""
    device: str
    threads: int | None
    """CPU threads of each worker; None for as many as its cluster grants."""

    def work(self, shared: Path) -> PairWork:
        """Return the work on each pair, without weights and images, of a task that was read from a folder."""
        return PairWork(
            experiment=self.experiment,
            folder=self.folder,
            inputs=self.inputs,
            weights=None,
            cameras={},
            keep_volumes=self.keep_volumes,
            refusals=warn.from_text(self.refusals),
            vectors=self.vectors,
            scratch=shared / INSTANTS,
        )


def write_task(work: PairWork, device: str, threads: int | None) -> Path:
    """Write the task and the weights into the run's folder; return the folder.

    Raises
    ------
    StorageError
        If there is no space for them.
    InputError
        If the folder belongs to somebody else, or a path is no text in UTF-8.
    """
    from lfpiv.weights.storage import save_weights

    root, token = work.folder.shared.absolute(), secrets.token_hex(8)
    base = root / token
    with writing(base):
        _make_private(root)
        base.mkdir(mode=0o700)
        _require_space(base, 0 if work.weights is None else work.weights.memory_bytes)
    experiment = _absolute(work.experiment)
    task = Task(
        version=__version__,
        experiment=experiment,
        folder=dataclasses.replace(work.folder, path=work.folder.path.absolute()),
        inputs=work.inputs,
        keep_volumes=work.keep_volumes,
        refusals=warn.to_text(work.refusals),
        vectors=work.vectors,
        weights=None if work.weights is None else save_weights(work.weights, base / WEIGHTS),
        device=device,
        threads=threads,
    )
    try:
        content = task.model_dump_json().encode()
    except (PydanticSerializationError, UnicodeEncodeError):
        raise InputError(
            f"{experiment.path}: expected paths that are text in UTF-8, which workers need. Rename the folder."
        ) from None
    shared = base / f"{_digest(content)}-{token}"
    with writing(shared):
        shared.mkdir(mode=0o700)
        (shared / TASK).write_bytes(content)
    return shared


def read_task(shared: Path) -> Task:
    """Read the task of a run from its folder.

    Raises
    ------
    OSError
        If the folder or the task cannot be read.
    InputError
        If the task is not the one that the run wrote, or is of another version.
    """
    content = (shared / TASK).read_bytes()
    if _digest(content) != shared.name.partition("-")[0]:
        raise InputError(f"{shared / TASK}: expected the task of this run, found one that was changed since.")
    try:
        return Task.model_validate_json(content)
    except ValidationError:
        raise InputError(f"{shared / TASK}: expected the task of lfpiv {__version__}, found another form.") from None


def open_weights_of(shared: Path, cameras: Mapping[str, CalibratedCamera]) -> Weights | None:
    """Return the weights that the workers of a run mapped; None if it needed none."""
    from lfpiv.weights.storage import open_weights

    content = read_task(shared).weights
    return None if content is None else open_weights(shared.parent / WEIGHTS, cameras, content)


def _make_private(root: Path) -> None:
    """Make a folder that only this user can use; refuse one of another user, and a link."""
    root.parent.mkdir(parents=True, exist_ok=True)
    try:
        root.mkdir(mode=0o700)
        return
    except FileExistsError:
        about = os.lstat(root)
    owner: Any = getattr(os, "geteuid", lambda: about.st_uid)()
    if not stat.S_ISDIR(about.st_mode) or about.st_uid != owner:
        found = f"one of user {about.st_uid}" if stat.S_ISDIR(about.st_mode) else "a link or a file"
        raise InputError(
            f"{root}: expected a folder of this user, in which the workers share files, found {found}. Remove it, or "
            "choose another --out."
        )
    root.chmod(0o700)


def _require_space(folder: Path, need: int) -> None:
    free = shutil.disk_usage(folder).free
    if need > free:
        raise StorageError(
            f"{folder}: workers share the weights as files of {size_text(need)}, {size_text(free)} are free there. "
            "Make room, or use one worker."
        )


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:DIGEST_CHARACTERS]


def _absolute(experiment: Experiment) -> Experiment:
    """Return the experiment with absolute paths, for processes that run in another folder."""
    cameras = tuple(
        dataclasses.replace(
            camera,
            white_path=camera.white_path.absolute(),
            dark_path=None if camera.dark_path is None else camera.dark_path.absolute(),
        )
        for camera in experiment.cameras
    )
    path, mask = experiment.path.absolute(), experiment.mask
    mask = None if mask is None else dataclasses.replace(mask, path=path)
    return dataclasses.replace(experiment, path=path, cameras=cameras, mask=mask)
