"""Checks of files before they are opened: only regular files are, since reading a pipe would block.

The text of a path in a sheet stays inside the experiment folder, but a link in the folder may lead outside, for example
to recordings on another disk. Its target must be a regular file or a folder, like every entry of the folder itself.
"""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

DISK_FULL_ERRORS = frozenset({errno.ENOSPC, errno.EDQUOT})  # Error numbers of a full disk or an exhausted quota


# Message for a FIFO, a socket, a terminal or a device such as `/dev/zero`
NOT_A_FILE = "it is a pipe or a device, not a file; put the file itself there, or a link to it"


def missing_file_message(path: Path) -> tuple[str, str]:
    """Return message and remedy for a missing file; a broken link, as to a disk that is not mounted, is named as such.
    Returns message, remedy.
    """
    if path.is_symlink():
        return (
            "is a link to something that does not exist",
            "connect the disk it points to, or copy the file itself there",
        )
    return "does not exist", "check the path and its upper and lower case"


def is_pipe_or_device(path: Path) -> bool:
    """Whether a path leads to something other than a file or folder, reading which may block or never end."""
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError):
        return False
    return not (stat.S_ISREG(mode) or stat.S_ISDIR(mode))


def file_size(path: Path) -> int:
    """Return the size of a readable regular file."""
    status = path.stat()
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, "it is a folder, not a file", str(path))
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, NOT_A_FILE, str(path))
    if not os.access(path, os.R_OK):
        raise PermissionError(errno.EACCES, "permission denied; allow it to be read", str(path))
    return status.st_size


def is_readable(path: Path) -> bool:
    """Whether a path leads to a readable regular file or folder."""
    try:
        return (path.is_dir() and os.access(path, os.R_OK | os.X_OK)) or file_size(path) >= 0
    except (OSError, ValueError):
        return False


def is_disk_full(error: BaseException) -> bool:
    """Whether an error means that the disk is full."""
    return isinstance(error, OSError) and error.errno in DISK_FULL_ERRORS
