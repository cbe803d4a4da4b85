"""The report of a run: one HTML page for people, with its pictures, data and scripts inside. `page` writes it."""
