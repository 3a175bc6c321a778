"""Opening files: what is missing, empty or not a file is said before parsing starts."""

from pathlib import Path

from lpvid.data._errors import DataError


def file_bytes(path: Path) -> bytes:
    """The file's content, not empty.

    Raises:
        DataError: the file is missing, a folder, unreadable or empty.
    """
    if not path.exists():
        raise DataError(f"{path}: no such file; check the path and the working folder.")
    if path.is_dir():
        raise DataError(f"{path} is a folder; name a file in it.")
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror}.") from error
    if not content.strip():
        raise DataError(f"{path} is empty.")
    return content
