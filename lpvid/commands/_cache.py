"""Compiled code kept between runs of the command line."""

import hashlib
import os
import platform
from pathlib import Path
from typing import Any

import jax

_OPT_OUT = "LPVID_NO_CACHE"


def keep_compiled_code() -> Path | None:
    """Turn on JAX's persistent cache in the user's cache folder; the folder, or `None`.

    `LPVID_NO_CACHE=1`, a cache configured already, or a folder that cannot be written leave all as
    it is: a cache saves time and is never a reason to fail.
    """
    configured: Any = jax.config
    if os.environ.get(_OPT_OUT, "0") not in ("", "0") or configured.jax_compilation_cache_dir:
        return None
    base = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    folder = Path(base) / "lpvid" / f"jax-{jax.__version__}-{_processor()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    if not os.access(folder, os.W_OK | os.X_OK):
        return None
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
    return folder


def _processor() -> str:
    """A short name of the processor's kind: a home folder may serve several machines."""
    described = platform.machine() + platform.processor()
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith(("model name", "flags", "Features")):
                described += line
            if not line:
                break
    except OSError:
        pass
    return hashlib.sha256(described.encode()).hexdigest()[:12]
