"""Build scenes of small rigs: the optics of the published experiment on sensors of a few hundred pixels."""

from lfpiv.simulation.scene import Scene

OPTICS = {
    "focal_length_mm": 100.0,
    "magnification": -1.0,
    "f_number": 4.0,
    "microlens_pitch_mm": 0.1,
    "microlens_focal_length_mm": 0.8,
}


def camera(name, angle_deg, pixels, *, pixel_um=8.0, **more):
    """Return the table of a camera of a scene; `pixels` are (columns, rows)."""
    sensor = {"pixel_um": pixel_um, "sensor_width_px": pixels[0], "sensor_height_px": pixels[1]}
    return OPTICS | sensor | {"name": name, "nominal_angle_deg": angle_deg} | more


def scene(name, cameras, *, planes_mm, spacing_mm=0.5, size_mm=(2.0, 2.0, 1.2), particles, displacement_mm, **more):
    """Return a scene: a board of 5 x 5 dots, voxels of 0.1 mm, and a uniform flow unless `more` has another."""
    return Scene.model_validate(
        {
            "name": name,
            "seed": 3,
            "dt_s": 1e-3,
            "camera": tuple(cameras),
            "board": {"dots": (5, 5), "spacing_mm": spacing_mm, "dot_diameter_mm": 0.1, "planes_mm": planes_mm},
            "volume": {"size_mm": size_mm, "voxel_mm": 0.1},
            "particles": particles,
            "flow": {"kind": "uniform", "displacement_mm": displacement_mm},
        }
        | more
    )
