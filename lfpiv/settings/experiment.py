"""The table of the whole experiment file."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from lfpiv.settings import bounds
from lfpiv.settings.bounds import Interval, Name
from lfpiv.settings.particles import Particles
from lfpiv.settings.processing import Bootstrap, Compute, Correlation, Network, SelfCalibration, Smart, Tracking
from lfpiv.settings.rig import Board, CameraTable
from lfpiv.settings.table import Table
from lfpiv.settings.volume import ExperimentVolume


class ExperimentTable(Table):
    """The whole experiment file."""

    name: Name
    """Name of the experiment, title of its report."""
    dt_s: Interval
    """Time between the two frames of a pair, or between instants k and k + step of a time series [s]."""
    camera: Annotated[tuple[CameraTable, ...], Field(min_length=1, max_length=bounds.MOST_CAMERAS)]
    board: Board
    volume: ExperimentVolume
    particles: Particles
    smart: Smart = Smart()
    correlation: Correlation = Correlation()
    tracking: Tracking | None = None
    network: Network = Network()
    self_calibration: SelfCalibration = SelfCalibration()
    bootstrap: Bootstrap = Bootstrap()
    compute: Compute = Compute()

    @property
    def used_tracking(self) -> Tracking | None:
        """Settings of the tracking, which a single camera has without a table; None without tracking."""
        return Tracking() if self.tracking is None and len(self.camera) == 1 else self.tracking
