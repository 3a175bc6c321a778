"""Models as JSON values and back, exactly."""

import dataclasses
import inspect
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from lpvid._results import Status
from lpvid.io._known import class_of, name_of
from lpvid.models import FunctionStructure

# 2: fields that a class has gained may be missing from files of version 1.
VERSION = 2
_DTYPES = ("bool", "int32", "int64", "float32", "float64", "complex128")
_NONFINITE = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}


def field_names(cls: type) -> tuple[str, ...]:
    """The fields of a class that files hold, in its constructor's order."""
    if dataclasses.is_dataclass(cls):
        return tuple(field.name for field in dataclasses.fields(cls))
    return cls._fields  # pyright: ignore[reportAttributeAccessIssue]  # a NamedTuple


def encode(value: Any, where: str) -> Any:
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
        return encode(value.item(), where)
    if isinstance(value, np.ndarray | jax.Array):
        return {"array": _encode_array(np.asarray(value), where)}
    if isinstance(value, FunctionStructure):
        raise ValueError(
            f"{where}: a FunctionStructure holds a Python function, which cannot be saved. Save "
            "the model's coefficients with NumPy and build the structure again in code, or save "
            "the frozen models lpv.at(kappa)."
        )
    if isinstance(value, type(Status.successful)):
        codes = np.asarray(jax.tree.leaves(value)[0])
        sentences = [_SENTENCES[code] for code in codes.reshape(-1).tolist()]
        return {"status": sentences, "shape": list(codes.shape)}
    name = name_of(type(value))
    if name is not None and list(inspect.signature(type(value)).parameters) == list(
        field_names(type(value))
    ):
        fields = {
            field: encode(getattr(value, field), f"{where}.{field}")
            for field in field_names(type(value))
        }
        return {"class": name, "fields": fields}
    if type(value) is tuple:
        return {"tuple": [encode(item, f"{where}[{i}]") for i, item in enumerate(value)]}
    if type(value) is dict and all(isinstance(key, str) for key in value):
        return {"dict": {key: encode(item, f"{where}[{key!r}]") for key, item in value.items()}}
    raise ValueError(
        f"{where}: a {type(value).__name__} cannot be saved; use the library's own models, "
        "structures, bases and results."
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


def decode(entry: Any, where: str, version: int) -> Any:
    """The value of a JSON entry; `where` says in messages which attribute it is.

    Args:
        entry: what the file holds.
        where: for messages.
        version: of the file.

    Raises:
        ValueError: the entry does not fit.
    """
    if entry is None or isinstance(entry, bool | int | float | str):
        return entry
    if isinstance(entry, dict):
        for tag, reader in _DECODERS.items():
            if tag in entry:
                return reader(entry, where, version)
    raise ValueError(f"{where} is neither a value nor an array, tuple or known class")


def _decode_class(entry: dict[str, Any], where: str, version: int) -> Any:
    name, fields = entry["class"], entry.get("fields")
    cls = class_of(name) if isinstance(name, str) else None
    if cls is None:
        raise ValueError(f"{where} is of the unknown class {name!r}")
    expected = field_names(cls)
    missing = set(_optional(cls)) if version < VERSION else set()
    if not isinstance(fields, dict) or not set(expected) - missing <= set(fields) <= set(expected):
        found = sorted(fields) if isinstance(fields, dict) else fields
        raise ValueError(f"{where} needs the fields {sorted(expected)}, found {found}")
    values = {
        field: decode(fields[field], f"{where}.{field}", version)
        for field in expected
        if field in fields
    }
    return cls(**values)


def _optional(cls: type) -> list[str]:
    parameters = inspect.signature(cls).parameters.values()
    return [each.name for each in parameters if each.default is not inspect.Parameter.empty]


def _decode_array(entry: dict[str, Any], where: str, version: int) -> jax.Array:
    del version
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


def _decode_tuple(entry: dict[str, Any], where: str, version: int) -> tuple[Any, ...]:
    return tuple(decode(item, f"{where}[{i}]", version) for i, item in enumerate(entry["tuple"]))


def _decode_dict(entry: dict[str, Any], where: str, version: int) -> dict[str, Any]:
    return {key: decode(item, f"{where}[{key!r}]", version) for key, item in entry["dict"].items()}


def _decode_float(entry: dict[str, Any], where: str, version: int) -> float:
    del where, version
    return _NONFINITE[entry["float"]]


def _decode_status(entry: dict[str, Any], where: str, version: int) -> Status:
    del version
    unknown = [sentence for sentence in entry["status"] if sentence not in _SENTENCES]
    if unknown:
        raise ValueError(f"{where} has the unknown status {unknown[0]!r}")
    codes = np.array([_SENTENCES.index(sentence) for sentence in entry["status"]], np.int32)
    return _status(codes.reshape(entry["shape"]))


def _status(code: np.ndarray | int) -> Any:
    # A status is stored by its sentence: the numbers change as the enumeration grows.
    structure = jax.tree.structure(Status.successful)
    return jax.tree.unflatten(structure, [np.asarray(code, np.int32)])


_SENTENCES = [Status[_status(code)] for code in range(len(Status))]

_DECODERS: dict[str, Callable[[dict[str, Any], str, int], Any]] = {
    "class": _decode_class,
    "array": _decode_array,
    "tuple": _decode_tuple,
    "dict": _decode_dict,
    "float": _decode_float,
    "status": _decode_status,
}
