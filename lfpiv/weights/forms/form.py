"""The rig whose weights are wanted, and what a form of the weights answers about it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

from lfpiv.progress import StepProgress
from lfpiv.weights.choice import Choice, form_errors
from lfpiv.weights.counting import CountedVoxels
from lfpiv.weights.memory_left import MemoryLeft
from lfpiv.weights.stored_grid import StoredGrid
from lfpiv_kernels.reconstruction.ray_projector import RayProjector

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera

PIXELS = Choice(form="pixels")
"""How footprints are stored where nothing is chosen, and how counted rays are."""


@dataclass(frozen=True, kw_only=True)
class Rig:
    """Voxels and cameras whose weights are wanted."""

    stored: StoredGrid
    cameras: Mapping[str, CalibratedCamera]
    memory: MemoryLeft
    """Memory that the weights may take."""
    choices: Mapping[str, Choice] = field(default_factory=dict)
    """How the footprints of each camera are computed."""
    rays: int = 0
    """Rays that are counted per voxel and camera; 0 for footprints."""
    shared: bool = True
    """Whether voxels may share weights: by profiles of a plane, or by nodes."""
    particle_voxel: float = 0.0
    """Standard deviation of the particles [voxel]; 0 where it is unknown."""

    def choice(self, name: str) -> Choice:
        """Return how the footprints of a camera are computed."""
        return self.choices.get(name, PIXELS)


class Form(ABC):
    """One form of the weights, for the cameras of a rig that have none yet.

    Parameters
    ----------
    names : iterable of str
        Cameras without weights.
    """

    projector: ClassVar[type[RayProjector]]
    """What projects with weights of this form."""
    parts: ClassVar[tuple[type, ...]]
    """Types of the values that `projector` is made from, and that files store."""

    def __init__(self, rig: Rig, names: Iterable[str]):
        self.rig, self.names = rig, tuple(names)

    @property
    def stored(self) -> StoredGrid:
        """The voxels in the order in memory that this form needs."""
        return self.rig.stored

    @property
    @abstractmethod
    def suits(self) -> Sequence[str]:
        """Cameras that have this form if their images are accurate, and whose weights fit into the memory."""

    @abstractmethod
    def host_bytes(self, name: str) -> int:
        """Estimate the memory of a camera's weights and rays on the host [byte]."""

    @abstractmethod
    def device_bytes(self, name: str) -> int:
        """Estimate the memory of a camera's weights on a GPU [byte]."""

    @abstractmethod
    def build(self, step: Callable[[str], StepProgress]) -> dict[str, RayProjector]:
        """Build the weights of the cameras that this form suits; leave out cameras whose images are not accurate.

        `step` returns what is called with the finished fraction of a camera.

        Raises
        ------
        InputError
            If the weights do not fit into the memory.
        """

    @classmethod
    @abstractmethod
    def load(
        cls, name: str, parts: Sequence[Any], cameras: Mapping[str, CalibratedCamera], memory: MemoryLeft
    ) -> RayProjector:
        """Make the projector of a camera from its parts; raise InputError if it does not fit into a GPU."""

    @staticmethod
    def count_errors(counted: CountedVoxels, projector: RayProjector, choice: Choice) -> list[float]:
        """Return the relative L2 differences of footprints from counted rays, one per counted voxel.

        Nodes and shared profiles serve particles; their images of particles were compared when they were chosen. So by
        default the voxels' own footprints are compared.
        """
        return form_errors(counted, projector.form, choice.cuts)
