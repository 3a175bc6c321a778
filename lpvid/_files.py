"""Files written whole or not at all."""

import os
import uuid
from pathlib import Path


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
