"""Temporary names beside an output, leftovers of killed writers, and writing through to the disk.

``.NAME-HOST-PID-RANDOM`` identifies its writer: six hex digits of the machine's name, and the process. With
``.old`` behind it, it is what stood under the final name until a moment ago.
"""

import errno
import hashlib
import os
import platform
import re
import secrets
import shutil
import time
from contextlib import suppress
from pathlib import Path

OLD = ".old"
_HOST = hashlib.sha256(platform.node().encode()).hexdigest()[:6]
_TAIL = re.compile(r"(?P<host>[0-9a-f]{6})-(?P<pid>[0-9]+)-[0-9a-f]{8}(?P<suffix>\..*)?")
_DAY_S = 86400.0
_NO_SYNC = (errno.EINVAL, errno.ENOTSUP, errno.EACCES, errno.EPERM, errno.EROFS)
"""Errors of a file system that cannot write through; a full or broken disk has others."""


def beside(target: Path, suffix: str = "", folder: Path | None = None) -> Path:
    """A free hidden name for what is to become `target`, in the same folder unless another is given."""
    name = f".{target.name}-{_HOST}-{os.getpid()}-{secrets.token_hex(4)}{suffix}"
    return (folder or target.parent) / name


def sweep(target: Path, folder: Path | None = None) -> None:
    """Remove leftovers of killed writers of `target`; leftovers that cannot be seen or removed stay.

    That is what has stood for a day, or whose process on this machine is gone. Where such a process took
    the old output aside and did not come to put the new one in its place, the old one is put back.
    """
    head = f".{target.name}-"
    try:
        names = os.listdir(folder or target.parent)
    except OSError:
        return
    for name in names:
        found = _TAIL.fullmatch(name.removeprefix(head)) if name.startswith(head) else None
        if found is None:
            continue
        path = (folder or target.parent) / name
        if not _abandoned(path, found["host"], int(found["pid"])):
            continue
        with suppress(OSError):
            if found["suffix"] == OLD and not os.path.lexists(target):
                path.rename(target)
            elif path.is_dir() and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink()


def _abandoned(path: Path, host: str, pid: int) -> bool:
    try:
        about = path.lstat()
    except OSError:
        return False
    # What was set aside has the times of when it was made; only its change of name is of now.
    if time.time() - max(about.st_mtime, about.st_ctime) > _DAY_S:
        return True
    return host == _HOST and not _runs(pid)


def _runs(pid: int) -> bool:
    """Whether a process of this machine may still be there."""
    if os.name != "posix" or pid <= 0:
        return True  # Elsewhere a signal of 0 is no question.
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True


def sync(path: Path) -> None:
    """Have a file, or all files of a folder and the folder itself, written through to the disk.

    Else a machine that goes down soon after a rename may have the new name with nothing in it.
    """
    if not path.is_dir():
        _sync_one(path)
        return
    for place, _, names in os.walk(path):
        for name in names:
            _sync_one(Path(place) / name)
        sync_folder(Path(place))


def sync_folder(folder: Path) -> None:
    """Have the names in a folder written through to the disk, where the platform can."""
    if os.name == "posix":
        _sync_one(folder)


def _sync_one(path: Path) -> None:
    flags = os.O_RDONLY if os.name == "posix" else os.O_RDWR
    try:
        handle = os.open(path, flags)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
    except OSError as error:
        if error.errno not in _NO_SYNC:
            raise
