"""The light-field PIV benchmark: cases with known truth, made from seeds, and scores of anybody's vectors on them."""
