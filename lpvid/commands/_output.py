"""Files that the commands write: checked before the work."""

import os
from collections.abc import Sequence
from pathlib import Path

from lpvid.commands._errors import UsageError

# Half a 95 % interval in standard deviations.
NORMAL_95 = 1.959963984540054


def check_targets(targets: dict[str, str | None], sources: Sequence[str] = ()) -> None:
    """Raise unless every file (option → path) can be written and is none of the sources."""
    read = {os.path.realpath(source): source for source in sources}
    taken: dict[str, str] = {}
    for option, name in targets.items():
        if name is None:
            continue
        path, real = Path(name), os.path.realpath(name)
        if path.is_dir():
            raise UsageError(f"{option}: {name} is a folder; name a file in it")
        if real in read:
            raise UsageError(f"{option}: {name} is read as data and would be overwritten")
        if real in taken:
            raise UsageError(f"{option}: {name} is {taken[real]}'s file too; give two names")
        taken[real] = option
        folder = Path(real).parent
        if not folder.is_dir():
            raise UsageError(f"{option}: the folder {folder} does not exist; make it first")
        if not os.access(folder, os.W_OK):
            raise UsageError(f"{option}: the folder {folder} cannot be written")


def make_folder(option: str, name: str) -> Path:
    """The folder, made where it is missing; raises where files cannot be written in it."""
    path = Path(name)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise UsageError(f"{option}: {name} is a file; name a folder") from None
    except OSError as error:
        raise UsageError(f"{option}: {name} cannot be made ({error.strerror})") from None
    if not os.access(path, os.W_OK | os.X_OK):
        raise UsageError(f"{option}: the folder {name} cannot be written")
    return path
