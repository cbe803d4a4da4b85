"""Readers of image files, one module for each format; `table` names the reader of each suffix."""
