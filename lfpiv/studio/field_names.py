"""What people call the fields of results, and their units."""

from __future__ import annotations

LABELS = {
    "speed": ("speed", "m/s"), "u": ("u", "m/s"), "v": ("v", "m/s"), "w": ("w", "m/s"),
    "vorticity_magnitude": ("vorticity", "1/s"), "vorticity_x": ("vorticity x", "1/s"),
    "vorticity_y": ("vorticity y", "1/s"), "vorticity_z": ("vorticity z", "1/s"), "q_criterion": ("Q", "1/s²"),
    "divergence": ("divergence", "1/s"), "pressure": ("pressure", "Pa"), "uncertainty": ("uncertainty", "voxel"),
    "peak_ratio": ("peak ratio", ""), "correlation": ("correlation", ""), "valid": ("valid", ""),
}  # fmt: skip
"""Fields in the order of the lists, what people call them, and their units. Others follow by their names."""
SURFACES = ("speed", "vorticity_magnitude", "q_criterion", "pressure", "u", "v", "w", "uncertainty")
"""Fields that have isosurfaces."""


def title_of(name: str) -> str:
    """Return what people call a field, with its unit."""
    text, unit = LABELS.get(name, (name.replace("_", " "), ""))
    return f"{text} [{unit}]" if unit else text
