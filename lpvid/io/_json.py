"""Models to JSON files and back: exact to the last bit, written whole or not at all."""

import json
import os
from pathlib import Path
from typing import Any

from lpvid._files import write_atomically
from lpvid.io._encoding import VERSION, decode, encode
from lpvid.io._known import known_classes
from lpvid.models import FunctionStructure

_FORMAT = "lpvid"


class ModelFileError(ValueError):
    """A file cannot be read as a model; the message names file, reason and remedy.

    Example:
        >>> from lpvid.io import ModelFileError, load
        >>> try:
        ...     load("missing.json")
        ... except ModelFileError as error:
        ...     print(error)
        missing.json: it cannot be read (No such file or directory); check the path and its ...
    """


def save(path: str | os.PathLike[str], obj: Any) -> Path:
    """Write a model, structure or basis, or a result that holds one, to a JSON file, exactly.

    Saved are `StateSpace`, `LPVStateSpace`, `StructuredModel`, the library's structures, bases and
    plants, and the results of `identify`, `refine` and `restructure` with all they hold (output
    offsets, initial states, noise models, covariances). Every float comes back bit for bit (a NaN
    as a NaN). The file is replaced in one step: an interruption leaves the old one.

    Args:
        path: where to.
        obj: what to save.

    Returns:
        The path.

    Raises:
        ValueError: an object that cannot be saved (a `FunctionStructure`, whose Python function has
            no place in a file; values traced by JAX).
        OSError: the folder is missing or not writable.

    Example:
        >>> from lpvid.io import load, save
        >>> from lpvid.models import StateSpace
        >>> path = save("lag.json", StateSpace([[-1.0]], [[1.0]], [[0.1]]))
        >>> load(path).C.item()
        0.1
    """
    name = type(obj).__name__
    if known_classes().get(name) is not type(obj) and not isinstance(obj, FunctionStructure):
        raise ValueError(
            f"obj: a {name} cannot be saved; saved are StateSpace, LPVStateSpace, StructuredModel, "
            "structures, bases, and the results of identify, refine and restructure. "
            "For records use a CSV or NumPy file."
        )
    document = {
        "format": _FORMAT,
        "version": VERSION,
        "kind": name,
        "fields": encode(obj, "obj")["fields"],
    }
    text = json.dumps(document, indent=1, allow_nan=False) + "\n"
    return write_atomically(path, text.encode())


def load(path: str | os.PathLike[str]) -> Any:
    """Read what `save` has written.

    Args:
        path: the file.

    Raises:
        ModelFileError: (a `ValueError`) the file is missing, unreadable, truncated, not lpvid's, of
            a newer version, of an unknown kind, or has fields that do not fit.

    Example:
        >>> from lpvid.io import load, save
        >>> from lpvid.models import ModalStructure
        >>> load(save("modes.json", ModalStructure(2, 1, 1))) == ModalStructure(2, 1, 1)
        True
    """
    document = _document(path)
    if not isinstance(document, dict) or document.get("format") != _FORMAT:
        raise _error(
            path,
            f'it is JSON but not a model file (no "format": "{_FORMAT}")',
            "give a file written by lpvid's save",
        )
    version = document.get("version")
    if not isinstance(version, int) or isinstance(version, bool) or version < 1:
        raise _error(path, f"its version {version!r} is no version number", "write it again")
    if version > VERSION:
        raise _error(
            path,
            f"its version is {version}, and this lpvid reads up to {VERSION}",
            "update lpvid, or save the model again with this one",
        )
    kind = document.get("kind")
    if not isinstance(kind, str) or kind not in known_classes():
        raise _error(
            path,
            f"its kind {kind!r} is unknown",
            "update lpvid if a newer one wrote it; otherwise write the file again",
        )
    try:
        return decode({"class": kind, "fields": document.get("fields")}, kind, version)
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        raise _error(path, f"its content does not fit: {error}", _AGAIN) from error


_AGAIN = "take an undamaged copy, or save the model again"


def _document(path: str | os.PathLike[str]) -> Any:
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise _error(
            path, f"it cannot be read ({reason})", "check the path and its permissions"
        ) from error
    if not content.strip():
        raise _error(path, "it is empty", _AGAIN)
    if not content.lstrip().startswith(b"{"):
        raise _error(path, "it is not a JSON object", "give a file written by lpvid's save")
    try:
        return json.loads(content.decode())
    except UnicodeDecodeError as error:
        raise _error(path, "it is not text in UTF-8", _AGAIN) from error
    except RecursionError as error:
        raise _error(path, "it is nested too deeply", _AGAIN) from error
    except json.JSONDecodeError as error:
        raise _error(
            path,
            f"it is truncated or damaged ({error.msg} in line {error.lineno})",
            _AGAIN,
        ) from error


def _error(path: str | os.PathLike[str], reason: str, remedy: str) -> ModelFileError:
    return ModelFileError(f"{os.fspath(path)}: {reason}; {remedy}.")
