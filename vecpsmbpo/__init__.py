"""Posterior-sampling model-based policy optimization, vectorized end to end in JAX and MJX."""

__version__ = "0.1.0"
