"""Settings of JAX that have to be made before its first computation."""

import os

import jax
import jaxlib

# Threads that XLA's CPU client is given; its default is one for each core.
_LEAST_THREADS = 32


def configure() -> None:
    """Ask for float64 everywhere, and for enough threads that batched LAPACK cannot deadlock.

    In jaxlib before 0.12 a batched LAPACK call waits on the thread pool it runs in: on a machine
    with few cores, several at once can take every thread and then wait for each other for
    ever. XLA reads the size of its pool from the environment variable NPROC when the first
    computation starts; a value set by the user stays.
    """
    # Identification squares condition numbers: everything here is float64, asked for once.
    jax.config.update("jax_enable_x64", True)
    if jaxlib.version.__version_info__ < (0, 12) and (os.cpu_count() or 1) < _LEAST_THREADS:
        os.environ.setdefault("NPROC", str(_LEAST_THREADS))
