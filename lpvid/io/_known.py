"""Which classes a file may hold."""

import functools
import importlib
import inspect
import sys
from types import ModuleType

import equinox as eqx

from lpvid.models import FunctionStructure

# Rooms whose public classes are saved under their own names.
_ROOMS = ("models", "mechanics", "identify", "refinement", "restructure")


@functools.cache
def known_classes() -> dict[str, type]:
    """The public classes by name. A file names these, and nothing else is ever imported."""
    found: dict[str, type] = {}
    for room in _ROOMS:
        public = vars(importlib.import_module(f"lpvid.{room}"))
        found |= {name: item for name, item in public.items() if _is_record(item)}
    del found[FunctionStructure.__name__]
    return found


def name_of(cls: type) -> str | None:
    """The name under which a class is saved, None for one that is not.

    A public class's own name; a room and the name for what results hold inside.
    """
    name = cls.__name__
    if known_classes().get(name) is cls:
        return name
    parts = cls.__module__.split(".")
    if parts[0] != "lpvid" or len(parts) < 2 or not _is_record(cls):
        return None
    qualified = f"{parts[1]}.{name}"
    return qualified if class_of(qualified) is cls else None


def class_of(name: str) -> type | None:
    """The class saved under a name, None where there is none."""
    room, dot, inner = name.rpartition(".")
    if not dot:
        return known_classes().get(name)
    for path, module in list(sys.modules.items()):
        if _in_room(path, room) and isinstance(module, ModuleType):
            item = vars(module).get(inner)
            if (
                _is_record(item)
                and item is not FunctionStructure
                and _in_room(item.__module__, room)
            ):
                return item
    return None


def _in_room(path: str, room: str) -> bool:
    return path == f"lpvid.{room}" or path.startswith(f"lpvid.{room}.")


def _is_record(item: object) -> bool:
    """Whether it is a class of arrays and values that is built from its fields by name."""
    if not inspect.isclass(item) or inspect.isabstract(item):
        return False
    module = issubclass(item, eqx.Module)
    return module or (issubclass(item, tuple) and hasattr(item, "_fields"))
