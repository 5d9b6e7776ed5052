"""Missing, empty, truncated and foreign files, found before a library opens them."""

import mmap
import zipfile
from pathlib import Path
from typing import Any

from jaxekf._support.errors import RecordingError

_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_ZIP = b"PK\x03\x04"
_SMALLEST_HEAP = 4096
_SMALLEST = 96
"""Bytes of the first version of HDF5's superblock; of later ones, with the root group, no less."""


def check_there(path: Path) -> None:
    """Raise `RecordingError` for a path that is no file, cannot be read or is empty."""
    hint = "another path"
    if path.is_dir():
        raise RecordingError(path, "a folder", "a file", hint)
    if not path.exists():
        raise RecordingError(path, "no such file", "a recorded run", hint)
    try:
        with path.open("rb") as file:
            empty = not file.read(1)
    except OSError as error:
        raise RecordingError(
            path, f"an unreadable file ({error.strerror})", "one that may be read", hint
        ) from error
    if empty:
        raise RecordingError(path, "an empty file (0 bytes)", "a recorded run", "copying it again")


def check_whole_zip(path: Path) -> None:
    """Raise `RecordingError` for what is no ZIP file, or one that is cut off."""
    with path.open("rb") as file:
        head = file.read(8)
    if head.startswith(_SIGNATURE):
        raise RecordingError(path, "an HDF5 file", "an NPZ file", "the suffix .h5")
    if zipfile.is_zipfile(path):
        return
    there = path.stat().st_size
    if head[:4] != _ZIP[: len(head)]:
        raise RecordingError(path, "a file that is not NPZ", "an NPZ file", "another file")
    member, end = _last_member(path, there)
    detail = f", and {member} alone ends at byte {end}" if end > there else ""
    got = f"a truncated file: {there} bytes without the central directory of an NPZ file{detail}"
    expected = f"more than {max(end, there)} bytes"
    raise RecordingError(path, got, expected, "copying or exporting it again")


def _last_member(path: Path, there: int) -> tuple[str, int]:
    """Name and end of the last member that begins in a ZIP file, from the heads of the members."""
    name, at = "the first data set", 0
    with path.open("rb") as file:
        while at + 30 <= there:
            file.seek(at)
            head = file.read(30)
            if head[:4] != _ZIP:
                break
            name_size, extra_size = (int.from_bytes(head[i : i + 2], "little") for i in (26, 28))
            name = file.read(name_size).decode("utf-8", "replace")[:80]
            extra, size = file.read(extra_size), int.from_bytes(head[18:22], "little")
            if size == 0xFFFFFFFF and extra[:2] == b"\x01\x00":
                size = int.from_bytes(extra[12:20], "little")
            at += 30 + name_size + extra_size + size
    return name, at


def check_whole_hdf5(path: Path) -> None:
    """Raise `RecordingError` for a file that is no HDF5 file, is shorter than its superblock states, or
    would keep the HDF5 library from ever coming back."""
    there = path.stat().st_size
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as view:
        at = 0
        while view[at : at + 8] != _SIGNATURE:
            at = 2 * at or 512
            if at >= there:
                _refuse_other(path, view[:8], there)
        stated, length = _superblock(view, at)
        if stated > there or there - at < _SMALLEST:
            detail = f"{stated} bytes, as its superblock states"
            got = f"a truncated file: {there} bytes"
            expected = detail if there - at >= _SMALLEST else f"more than {at + _SMALLEST} bytes"
            raise RecordingError(path, got, expected, "copying or exporting it again")
        _refuse_endless_heaps(path, view, length)


def _refuse_other(path: Path, head: bytes, there: int) -> None:
    if head.startswith(_ZIP):
        raise RecordingError(path, "a ZIP (NPZ) file", "an HDF5 file", "the suffix .npz")
    if head == _SIGNATURE[: len(head)]:
        detail = f"a truncated file: {there} bytes, not even HDF5's signature"
        raise RecordingError(path, detail, "a whole HDF5 file", "copying or exporting it again")
    raise RecordingError(path, "a file that is not HDF5", "an HDF5 file", "another file")


def _superblock(view: Any, at: int) -> tuple[int, int]:
    """The end of the file that its superblock states, and how many bytes a length has."""
    head = view[at : at + 96].ljust(96, b"\0")
    version = head[8]
    offset_size, length_size = (head[13], head[14]) if version < 2 else (head[9], head[10])
    first = {0: 24, 1: 28}.get(version, 12)
    # Base address, one other address, end of file.
    begin = first + 2 * offset_size
    return int.from_bytes(head[begin : begin + offset_size], "little"), length_size


def _refuse_endless_heaps(path: Path, view: Any, length_size: int) -> None:
    """Raise where texts of any length are in a heap over which the HDF5 library might never end.

    It walks a heap's objects by their size, modulo 2^64; a free one (number 0) of size 0, or what an object
    that runs past the end leads to, keeps it where it is.
    """
    head, at = 8 + length_size, -1
    aligned = (head + 7) // 8 * 8
    while (at := view.find(b"GCOL\x01", at + 1)) >= 0:
        size = int.from_bytes(view[at + 8 : at + head], "little")
        end, here = at + size, at + aligned
        if size < _SMALLEST_HEAP or end > len(view):
            # The library refuses it itself, or these are bytes of some number.
            continue
        while here + aligned <= end:
            size = int.from_bytes(view[here + 8 : here + head], "little")
            number = int.from_bytes(view[here : here + 2], "little")
            step = aligned + (size + 7) // 8 * 8 if number else size
            if step == 0 or here + step > end:
                got = f"a damaged heap of texts at byte {here}"
                expected = "a whole HDF5 file"
                raise RecordingError(path, got, expected, "copying or exporting it again")
            here += step
