"""
Main lenses, and how they bend rays
===================================

Rays of one object point through published main lenses, traced exactly. An ideal lens sends them to one point of the
array if it is in focus, and to places linear in the pupil point (u, v) if it is not. What a lens does beside that is
drawn over its pupil, in microlens pitches: rays less the nearest polynomial of second order, which a dot of the board
shows by itself, and less the polynomial of fifth order, which a calibration follows.
"""

import matplotlib.pyplot as plt
import numpy as np

from lfpiv.simulation.scene import SceneCamera, true_mapping

lenses = {"Double Gauss": ("double_gauss", 4.0), "Cooke triplet": ("cooke_triplet", 4.0), "Tessar": ("tessar", 4.5)}
point_mm = np.array([0.8, 0.5, 0.4])
radius = np.sqrt(np.linspace(0.0, 1.0, 40))
angle = np.linspace(0, 2 * np.pi, 73)
u, v = (part.ravel() for part in np.meshgrid(radius, angle, indexing="ij"))
u, v = u * np.cos(v), u * np.sin(v)


def rays_pitch(prescription, f_number):
    """Where the rays of the point meet the array [pitch], over the pupil."""
    camera = SceneCamera.model_validate(
        {
            **{"name": "one", "focal_length_mm": 100.0, "magnification": -1.0, "f_number": f_number, "pixel_um": 8.0},
            **{"microlens_pitch_mm": 0.1, "microlens_focal_length_mm": 0.2 * f_number, "nominal_angle_deg": 30.0},
            **{"sensor_width_px": 400, "sensor_height_px": 400, "lens": {"prescription": prescription}},
        }
    )
    pupil = camera.optics.pupil_radius_mm * np.stack([u, v], axis=1)
    return true_mapping(camera)(np.tile(point_mm, (len(pupil), 1)), pupil) / camera.microlens_pitch_mm


def left_over(rays, order):
    """Rays less the nearest polynomial of the pupil point."""
    terms = np.stack([u**a * v**b for a in range(order + 1) for b in range(order + 1 - a)], axis=1)
    return rays - terms @ np.linalg.lstsq(terms, rays, rcond=None)[0]


figure, axes = plt.subplots(2, 3, figsize=(9, 5.6), layout="constrained", sharex=True, sharey=True)
for column, (name, lens) in zip(axes.T, lenses.items(), strict=True):
    rays = rays_pitch(*lens)
    for axis, order in zip(column, (2, 5), strict=True):
        s, t = left_over(rays, order).T
        size = np.hypot(s, t)
        shown = axis.tripcolor(u, v, size, shading="gouraud", cmap="viridis")
        some = (np.hypot(u, v) > 0.1) & (np.arange(u.size) % 31 == 0)
        axis.quiver(u[some], v[some], s[some], t[some], color="white", width=0.006)
        axis.set_title(f"{name}, f/{lens[1]:g}\nbeyond order {order}: {np.sqrt((size**2).mean()):.4f}", fontsize=9)
        axis.set_aspect("equal")
        figure.colorbar(shown, ax=axis, label="[pitch]")
for axis in axes[-1]:
    axis.set_xlabel("u [pupil radii]")
for axis in axes[:, 0]:
    axis.set_ylabel("v [pupil radii]")
plt.show()

# %%
# Nearly all of the Double Gauss is spherical aberration, of third order: weights pixel by pixel and the dots of the
# board follow it. The simple lenses at full aperture bend rays at the rim further than the fifth order says; the
# calibration states how far, and where. What that costs a measurement is in the table of the page on accuracy.
