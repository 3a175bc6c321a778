"""`lpvid info`: what a report of a fault needs."""

import argparse
import importlib.metadata
import os
import platform

import jax
import jax.numpy as jnp

from lpvid import __version__
from lpvid.commands._cache import keep_compiled_code
from lpvid.commands._messages import Warnings

_PACKAGES = ("jax", "jaxlib", "equinox", "optimistix", "lineax", "jaxopt", "numpy", "scipy")


def run(arguments: argparse.Namespace, warnings: Warnings) -> None:
    """Print versions, devices, precision, cores and the cache's folder."""
    del arguments, warnings
    rows = [("lpvid", __version__), ("python", platform.python_version())]
    rows += [(name, _version(name)) for name in _PACKAGES]
    rows += [
        ("system", platform.platform()),
        ("devices", ", ".join(f"{d.platform} ({d.device_kind})" for d in jax.devices())),
        ("precision", str(jnp.zeros(0).dtype)),
        ("cores", str(_cores())),
        ("compiled code", str(keep_compiled_code() or "not kept")),
    ]
    width = max(len(name) for name, _ in rows)
    for name, value in rows:
        print(f"{name:<{width}}  {value}")


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def _cores() -> int:
    # Those this process may use: a container often has fewer than the machine.
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:
        return os.cpu_count() or 1
