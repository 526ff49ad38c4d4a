"""Files as an experiment may hold them: what is no ordinary file is never opened, since a pipe would be waited for.

What a sheet names is a path inside the folder by its text. A link there may lead to a file or a folder elsewhere, as to
recordings on another disk; what it ends at must be an ordinary file, as must every file of the folder itself.
"""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

DISK_FULL_ERRORS = frozenset({errno.ENOSPC, errno.EDQUOT})
"""Errors of a disk, or a share of one, on which nothing more can be written."""


NOT_A_FILE = "it is a pipe or a device, not a file; put the file itself there, or a link to it"
"""What is said of a FIFO, a socket, a terminal or anything like `/dev/zero`."""


def missing_file_message(path: Path) -> tuple[str, str]:
    """What is said of a file that is not there, and what to do.

    Parameters
    ----------
    path : of the file; a link whose end is missing, as one to a disk that is not mounted, is named as such.

    Returns
    -------
    message, remedy
    """
    if path.is_symlink():
        return (
            "is a link to something that does not exist",
            "connect the disk it points to, or copy the file itself there",
        )
    return "does not exist", "check the path and its upper and lower case"


def is_pipe_or_device(path: Path) -> bool:
    """Whether a path ends at something that a program would wait for, or read for ever.

    Parameters
    ----------
    path : or a link to it.

    Returns
    -------
    False for files and folders, and where there is nothing.
    """
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError):
        return False
    return not (stat.S_ISREG(mode) or stat.S_ISDIR(mode))


def file_size(path: Path) -> int:
    """Size of an ordinary file that may be read.

    Parameters
    ----------
    path : the file, or a link to it.

    Returns
    -------
    bytes.

    Raises
    ------
    OSError
        With a `strerror` for a person: there is none, it may not be read, it is a folder, a pipe or a device.
    """
    status = path.stat()
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, "it is a folder, not a file", str(path))
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, NOT_A_FILE, str(path))
    if not os.access(path, os.R_OK):
        raise PermissionError(errno.EACCES, "permission denied; allow it to be read", str(path))
    return status.st_size


def is_readable(path: Path) -> bool:
    """Whether a path leads to an ordinary file, or a folder, that may be read.

    Parameters
    ----------
    path : whatever a sheet names.

    Returns
    -------
    False also where there is nothing.
    """
    try:
        return (path.is_dir() and os.access(path, os.R_OK | os.X_OK)) or file_size(path) >= 0
    except (OSError, ValueError):
        return False


def is_disk_full(error: BaseException) -> bool:
    """Whether an error says that the disk is full.

    Parameters
    ----------
    error : as it was raised.

    Returns
    -------
    True for a full disk or a quota that is used up.
    """
    return isinstance(error, OSError) and error.errno in DISK_FULL_ERRORS
