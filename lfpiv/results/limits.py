"""Limits of figures of results, from which people and warnings judge them."""

CLEAR_RESIDUAL = 0.6
"""Largest residual of a volume of clear images. They have 0.3 to 0.5, dim ones up to 0.6."""
LARGE_RESIDUAL = 0.75
"""Residual of a volume above which its vectors are doubtful."""
