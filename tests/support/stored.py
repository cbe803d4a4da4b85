"""Change stored results as another program or a mistake would."""

import h5py
import numpy as np
from support import ideal_rig

from lfpiv import hdf5
from lfpiv.calibration.camera import CalibratedCamera, Calibration
from lfpiv.calibration.network import Network
from lfpiv.calibration.quality import LensArrayQuality
from lfpiv.calibration.thin_lens_model import thin_lens_model
from lfpiv.geometry.optics import LensLattice
from lfpiv.lightfield.decoder import LightFieldDecoder
from lfpiv.lightfield.standing_light import StandingLight
from lfpiv.warn import Code, Warning


def rewrite(path, change, *, sealed=False):
    """Apply `change` to an HDF5 file; seal it again, or leave it as a program that knows no seals does."""
    with h5py.File(path, "r+") as file:
        change(file)
    if sealed:
        hdf5.seal(path)


def small_calibration():
    """Return a calibration of two cameras with everything that its file holds: valid in form, not in physics."""
    rng, cameras = np.random.default_rng(0), {}
    optics = ideal_rig.optics(48, 64, pixel_mm=0.01)
    lattice = LensLattice(origin_mm=(0.03, -0.02), basis_mm=((0.1, 0.0), (0.0, 0.1)))
    for name in ("left", "right"):
        network = Network(
            weights=(rng.normal(size=(5, 6)), rng.normal(size=(6, 2))),
            biases=(rng.normal(size=6), rng.normal(size=2)),
            input_centre=np.zeros(5),
            input_scale=np.ones(5),
            output_centre=np.zeros(2),
            output_scale=np.ones(2),
        )
        cameras[name] = CalibratedCamera(
            name=name,
            optics=optics,
            lattice=lattice,
            decoder=LightFieldDecoder.from_white(optics, lattice, rng.uniform(500, 1000, (48, 64))),
            network=network,
            baseline=thin_lens_model(optics, 30.0),
            region_mm=np.array([[-1.0, -1.0, -0.5], [1.0, 1.0, 0.5]]),
            report=LensArrayQuality(
                lens_array_rms_px=0.01, lens_array_pitch_px=10.0, lens_array_rotation_deg=0.0, lenses=30
            ),
            warnings=(Warning(code=Code.DOT_WIDTH, subject=name, figures={"seen_mm": 0.1, "stated_mm": 0.2}),),
            test_errors=rng.random(20),
        )
    return Calibration(cameras)


def small_background(calibration):
    """Return standing light of all cameras of a calibration, without its hash."""
    rng, found = np.random.default_rng(1), {}
    for name, camera in calibration.cameras.items():
        shape = camera.optics.sensor_shape
        found[name] = StandingLight(
            light=(rng.random(shape, np.float32), rng.random(shape, np.float32)),
            unusable=rng.random(shape) > 0.9,
            region=rng.random(shape) > 0.5,
            found=True,
            stray=0.5,
            ratio=None,
        )
    return found
