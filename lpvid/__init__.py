"""Differentiable system identification and linear parameter-varying (LPV) modelling."""

import jax

# Identification squares condition numbers: everything here is float64, asked for once, now.
jax.config.update("jax_enable_x64", True)

__version__ = "0.1.0"
