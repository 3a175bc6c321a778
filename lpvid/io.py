"""Models to files and back: JSON, exact to the last bit, written whole or not at all."""

import dataclasses
import json
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from lpvid._files import write_atomically
from lpvid.mechanics import ArmScales, DissipativeTwoLinkArm, TwoLinkArmStructure
from lpvid.models import (
    FreeStructure,
    FunctionStructure,
    LPVStateSpace,
    MechanicalStructure,
    ModalStructure,
    PolynomialBasis,
    StateSpace,
    StructuredModel,
)

_FORMAT = "lpvid"
_VERSION = 1

# What a file may hold. A class is built by its constructor, which takes its fields by name, so
# that a damaged or edited file is checked as any other argument; nothing else is ever imported.
_CLASSES: dict[str, type] = {
    cls.__name__: cls
    for cls in (
        StateSpace,
        LPVStateSpace,
        FreeStructure,
        ModalStructure,
        MechanicalStructure,
        TwoLinkArmStructure,
        DissipativeTwoLinkArm,
        ArmScales,
        PolynomialBasis,
        StructuredModel,
    )
}
_DTYPES = ("bool", "int32", "int64", "float32", "float64", "complex128")
_NONFINITE = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}


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
    """Write a model, structure or basis to a JSON file, exactly.

    Saved are `StateSpace`, `LPVStateSpace`, `StructuredModel` and the library's structures and
    bases. Every float comes back bit for bit (a NaN as a NaN). The file is replaced in one step: an
    interruption leaves the old one.

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
    if _CLASSES.get(name) is not type(obj) and not isinstance(obj, FunctionStructure):
        raise ValueError(
            f"obj: a {name} cannot be saved; saved are {', '.join(_CLASSES)}. "
            "For records use a CSV or NumPy file."
        )
    document = {
        "format": _FORMAT,
        "version": _VERSION,
        "kind": name,
        "fields": _encode(obj, "obj")["fields"],
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
    if version > _VERSION:
        raise _error(
            path,
            f"its version is {version}, and this lpvid reads up to {_VERSION}",
            "update lpvid, or save the model again with this one",
        )
    kind = document.get("kind")
    if not isinstance(kind, str) or kind not in _CLASSES:
        raise _error(
            path,
            f"its kind {kind!r} is unknown (known: {', '.join(_CLASSES)})",
            "update lpvid if a newer one wrote it; otherwise write the file again",
        )
    try:
        return _decode({"class": kind, "fields": document.get("fields")}, kind)
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


def _field_names(cls: type) -> tuple[str, ...]:
    if dataclasses.is_dataclass(cls):
        return tuple(field.name for field in dataclasses.fields(cls))
    return cls._fields  # pyright: ignore[reportAttributeAccessIssue]  # a NamedTuple


def _encode(value: Any, where: str) -> Any:
    """JSON for a value; `where` says in messages which attribute it is.

    Raises:
        ValueError: the value cannot be saved.
    """
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else {"float": _name_nonfinite(value)}
    if isinstance(value, Tracer):
        raise ValueError(f"{where}: its values are traced by JAX; save outside jit, vmap and grad.")
    if isinstance(value, np.generic):
        return _encode(value.item(), where)
    if isinstance(value, np.ndarray | jax.Array):
        return {"array": _encode_array(np.asarray(value), where)}
    if isinstance(value, FunctionStructure):
        raise ValueError(
            f"{where}: a FunctionStructure holds a Python function, which cannot be saved. Save "
            "the model's coefficients with NumPy and build the structure again in code, or save "
            "the frozen models lpv.at(kappa)."
        )
    name = type(value).__name__
    if _CLASSES.get(name) is type(value):
        fields = {
            field: _encode(getattr(value, field), f"{where}.{field}")
            for field in _field_names(type(value))
        }
        return {"class": name, "fields": fields}
    if type(value) is tuple:
        return {"tuple": [_encode(item, f"{where}[{i}]") for i, item in enumerate(value)]}
    raise ValueError(
        f"{where}: a {name} cannot be saved; use one of the library's structures and bases "
        f"({', '.join(_CLASSES)})."
    )


def _encode_array(array: np.ndarray, where: str) -> dict[str, Any]:
    if array.dtype.name not in _DTYPES:
        raise ValueError(f"{where}: arrays of {array.dtype} cannot be saved; use float64.")
    flat = np.ascontiguousarray(array).reshape(-1)
    # A complex number is stored as two floats, one after the other.
    values = (flat.view(np.float64) if array.dtype.kind == "c" else flat).tolist()
    if array.dtype.kind in "fc":
        values = [v if math.isfinite(v) else _name_nonfinite(v) for v in values]
    return {"dtype": array.dtype.name, "shape": list(array.shape), "values": values}


def _name_nonfinite(value: float) -> str:
    return "nan" if math.isnan(value) else "inf" if value > 0 else "-inf"


def _decode(entry: Any, where: str) -> Any:
    if entry is None or isinstance(entry, bool | int | float | str):
        return entry
    if isinstance(entry, dict):
        for tag, decode in _DECODERS.items():
            if tag in entry:
                return decode(entry, where)
    raise ValueError(f"{where} is neither a value nor an array, tuple or known class")


def _decode_class(entry: dict[str, Any], where: str) -> Any:
    name, fields = entry["class"], entry.get("fields")
    if name not in _CLASSES:
        raise ValueError(f"{where} is of the unknown class {name!r}")
    expected = _field_names(_CLASSES[name])
    if not isinstance(fields, dict) or set(fields) != set(expected):
        found = sorted(fields) if isinstance(fields, dict) else fields
        raise ValueError(f"{where} needs the fields {sorted(expected)}, found {found}")
    values = {field: _decode(fields[field], f"{where}.{field}") for field in expected}
    return _CLASSES[name](**values)


def _decode_array(entry: dict[str, Any], where: str) -> jax.Array:
    array = entry["array"]
    if not isinstance(array, dict) or set(array) != {"dtype", "shape", "values"}:
        raise ValueError(f"{where} needs dtype, shape and values")
    if array["dtype"] not in _DTYPES:
        raise ValueError(f"{where} has the unknown dtype {array['dtype']!r}")
    dtype, shape, values = np.dtype(array["dtype"]), array["shape"], array["values"]
    if dtype.kind in "fc":
        values = [_NONFINITE[v] if isinstance(v, str) else v for v in values]
    stored = np.dtype(np.float64) if dtype.kind == "c" else dtype
    flat = np.array(values, dtype=stored).view(dtype)
    if flat.ndim != 1 or math.prod(shape) != flat.size or min(shape, default=0) < 0:
        raise ValueError(f"{where} has {flat.size} values for the shape {shape}")
    return jnp.asarray(flat.reshape(shape))


def _decode_tuple(entry: dict[str, Any], where: str) -> tuple[Any, ...]:
    return tuple(_decode(item, f"{where}[{i}]") for i, item in enumerate(entry["tuple"]))


def _decode_float(entry: dict[str, Any], where: str) -> float:
    del where
    return _NONFINITE[entry["float"]]


_DECODERS: dict[str, Callable[[dict[str, Any], str], Any]] = {
    "class": _decode_class,
    "array": _decode_array,
    "tuple": _decode_tuple,
    "float": _decode_float,
}
