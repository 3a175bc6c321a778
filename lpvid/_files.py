"""Files written whole or not at all."""

import io
import json
import math
import os
import uuid
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np


def write_atomically(path: str | os.PathLike[str], content: bytes) -> Path:
    """Write bytes to a file so that a reader sees the old file or the new one, never a part.

    The bytes go to a temporary file in the same folder, which then replaces the target; an
    interruption leaves the old file as it was. Missing folders are not made.

    Args:
        path: where to; a link's target is replaced, not the link.
        content: the whole of the new file.

    Returns:
        The path given.

    Raises:
        OSError: the folder is missing or not writable.

    Example:
        >>> write_atomically("note.txt", b"hello").read_bytes()
        b'hello'
    """
    # A link is followed: its target is replaced, not the link.
    target = Path(os.path.realpath(path))
    temporary = target.with_name(f".{target.name}.{uuid.uuid4().hex}.part")
    try:
        with open(temporary, "xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)
    return Path(path)


def write_arrays(path: str | os.PathLike[str], arrays: Mapping[str, np.ndarray]) -> Path:
    """Write named arrays as an `.npz` archive, whole or not at all.

    Args:
        path: where to, see `write_atomically`.
        arrays: numbers, truth values or text by name.

    Returns:
        The path given.

    Raises:
        OSError: the folder is missing or not writable.

    Example:
        >>> path = write_arrays("numbers.npz", {"runs": np.arange(3)})
        >>> read_arrays(path)["runs"].tolist()
        [0, 1, 2]
    """
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    return write_atomically(path, buffer.getvalue())


def read_arrays(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """The arrays of an `.npz` archive by name; see `write_arrays`.

    Args:
        path: the archive. Nothing in it is executed.

    Raises:
        ValueError: the file is damaged or no such archive.
        OSError: it cannot be read.

    Example:
        >>> read_arrays(write_arrays("one.npz", {"runs": np.zeros(1)}))["runs"].shape
        (1,)
    """
    content = io.BytesIO(Path(path).read_bytes())
    try:
        with np.load(content, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (ValueError, EOFError, KeyError, AttributeError, TypeError, zipfile.BadZipFile) as error:
        raise ValueError(f"{os.fspath(path)}: damaged, or no archive of arrays.") from error


def write_json(path: str | os.PathLike[str], content: Mapping[str, Any]) -> Path:
    """Write figures as strict JSON, whole or not at all; a number that is not finite becomes null.

    Args:
        path: where to, see `write_atomically`.
        content: numbers, text, arrays, and lists and mappings of them.

    Returns:
        The path given.

    Raises:
        OSError: the folder is missing or not writable.

    Example:
        >>> write_json("figures.json", {"error": np.array([0.5, np.nan])}).read_text().split()
        ['{', '"error":', '[', '0.5,', 'null', ']', '}']
    """
    text = json.dumps(plain(content), indent=1, allow_nan=False, ensure_ascii=False) + "\n"
    return write_atomically(path, text.encode())


def plain(value: Any) -> Any:
    """Arrays as lists, numbers that are not finite as `None`: what strict JSON can hold.

    Args:
        value: a number, text, an array, or lists and mappings of them.

    Example:
        >>> plain({"gain": np.array([1.0, np.inf])})
        {'gain': [1.0, None]}
    """
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return plain(np.asarray(value).tolist())
