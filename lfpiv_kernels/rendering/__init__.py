"""Images of particles through real optics, for the simulator (Taichi)."""
