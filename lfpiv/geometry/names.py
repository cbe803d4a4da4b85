"""Names in datasets that several packages share."""

PARTICLE = "particle"
"""Dimension of a table of particles."""
COMPONENTS = {"x": "u", "y": "v", "z": "w"}
"""Axis -> velocity along it."""
