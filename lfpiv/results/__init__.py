"""The output folder and its files: written whole, marked with what they depend on, read back, exported."""
