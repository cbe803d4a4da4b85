"""Fields computed from velocity vectors: gradient, vorticity, divergence, Q criterion, strain rate."""

from lfpiv.velocity.derived import divergence, q_criterion, strain_rate, velocity_gradient, vorticity

__all__ = ["divergence", "q_criterion", "strain_rate", "velocity_gradient", "vorticity"]
