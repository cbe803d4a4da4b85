"""An ideal thin-lens camera, written from section 1 of the conventions, for tests of weights and volumes."""

from dataclasses import dataclass, field

import numpy as np

from lfpiv.geometry.optics import LensLattice, Optics
from lfpiv.lightfield.microimage_layout import microimages_of


def rotation(yaw_deg, pitch_deg=0.0, roll_deg=0.0):
    a, b, c = np.radians([yaw_deg, pitch_deg, roll_deg])
    about_y = [[np.cos(a), 0, -np.sin(a)], [0, 1, 0], [np.sin(a), 0, np.cos(a)]]
    about_x = [[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]]
    about_z = [[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]]
    return np.array(about_z) @ about_x @ about_y


def optics(rows=400, columns=480, layout="square", pixel_mm=0.0055):
    return Optics(
        focal_length_mm=100.0,
        magnification=-1.0,
        f_number=4.0,
        microlens_pitch_mm=0.1,
        microlens_focal_length_mm=0.8,
        pixel_mm=pixel_mm,
        sensor_shape=(rows, columns),
        layout=layout,
    )


def lattice(layout="square", roll_deg=0.0, origin_mm=(0.031, -0.022), pitch_mm=0.1):
    a = np.radians(roll_deg)
    second = (0.0, 1.0) if layout == "square" else (0.5, np.sqrt(3) / 2)
    turn = np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]])
    basis = pitch_mm * np.array([(1.0, 0.0), second]) @ turn
    return LensLattice(origin_mm=origin_mm, basis_mm=tuple(map(tuple, basis)), layout=layout)


@dataclass
class IdealCamera:
    """Camera for `build_weights`. `coma` adds second-order terms of the pupil position [mm at the pupil's edge]."""

    name: str
    pose: np.ndarray
    optics: Optics = field(default_factory=optics)
    lattice: LensLattice = field(default_factory=lattice)
    coma: float = 0.0

    def __post_init__(self):
        self.gain = np.ones(self.optics.sensor_shape, np.float32)
        self.microimages = microimages_of(self.optics, self.lattice)

    def map(self, points, pupil):
        camera = np.asarray(points, float) @ self.pose.T
        pupil = np.asarray(pupil, float)
        si, f = self.optics.image_distance_mm, self.optics.focal_length_mm
        distance = self.optics.object_distance_mm - camera[:, 2]
        m = si / distance
        st = (1 - si / f + m)[:, None] * pupil - m[:, None] * camera[:, :2]
        unit = pupil / self.optics.pupil_radius_mm
        st[:, 0] += self.coma * (3 * unit[:, 0] ** 2 + unit[:, 1] ** 2) / 3
        st[:, 1] += self.coma * 2 * unit[:, 0] * unit[:, 1] / 3
        return st

    def map_fan(self, points, pupil):
        every = np.repeat(points, len(pupil), axis=0), np.tile(pupil, (len(points), 1))
        return self.map(*every).reshape(len(points), len(pupil), 2).astype(np.float32)


@dataclass
class IdealRig:
    """Calibration for `build_weights`."""

    cameras: dict


def two_cameras(**keywords):
    poses = {"cam1": rotation(44.2, 0.3, -0.4), "cam2": rotation(-45.9, -0.2, 0.25)}
    return IdealRig({name: IdealCamera(name, pose, **keywords) for name, pose in poses.items()})
