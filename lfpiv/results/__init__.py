"""The output folder and its files: write them atomically with stamps of their origin, read and export them."""
