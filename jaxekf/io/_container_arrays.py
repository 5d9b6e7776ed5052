"""HDF5 and NPZ files as named arrays: what a file declares is judged before anything is read.

No file is trusted: declared sizes are compared with the file's own, pickled objects are never
loaded, links to other files never followed, and what the libraries raise becomes one `RecordingError`.
"""

import math
import warnings
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from jaxekf._support.errors import RecordingError
from jaxekf.io._container_integrity import check_there, check_whole_hdf5, check_whole_zip

SUFFIXES = {".npz": "npz", ".h5": "hdf5", ".hdf5": "hdf5"}
_MOST_PACKED = 1100
"""No array is packed closer than this: deflate reaches 1,032 to 1."""
_ALWAYS = 1 << 20
"""Bytes that may be declared whatever the file's size."""


class Stored(NamedTuple):
    """One array of a file, not yet read."""

    dtype: np.dtype
    """``object`` for texts of any length in HDF5."""
    shape: tuple[int, ...]
    read: Callable[[], NDArray[Any]]


class Content(NamedTuple):
    """Content of an open file."""

    arrays: dict[str, Stored]
    """By path, ``optical/time_ns``; of the groups that were asked for."""
    attributes: dict[str, Any]
    """Attributes of the root by name, and of the arrays as ``optical/time_ns@unit``."""
    others: list[str]
    """Names of everything else, which is not read."""


@contextmanager
def open_container(path: Path, groups: tuple[str, ...], root: tuple[str, ...]) -> Iterator[Content]:
    """The arrays of some `groups` and the attributes `root` of an HDF5 or NPZ file, by its suffix.

    Raises `RecordingError` for what cannot be read, here and for whatever a library raises in the block.
    """
    form = SUFFIXES[path.suffix.lower()]
    check_there(path)
    try:
        # A library that only warns of a damaged head goes on to judge it.
        with warnings.catch_warnings(action="ignore"):
            if form == "npz":
                check_whole_zip(path)
                with zipfile.ZipFile(path) as archive:
                    yield _npz_content(path, archive, groups, root)
            else:
                check_whole_hdf5(path)
                with h5py.File(path, "r") as file:
                    yield _hdf5_content(path, file, groups, root)
    except RecordingError:
        raise
    except Exception as error:
        message = " ".join(str(error).split()) or type(error).__name__
        got = f"a damaged file ({message})"
        expected = f"a whole {form.upper()} file"
        raise RecordingError(path, got, expected, "copying or exporting it again") from None


def check_sizes(path: Path, arrays: dict[str, Stored]) -> None:
    """Raise `RecordingError` where arrays declare more than a file of this size can hold."""
    there = path.stat().st_size
    limit, total = _MOST_PACKED * there + _ALWAYS, 0
    for key, stored in arrays.items():
        size = stored.dtype.itemsize * math.prod(stored.shape)
        total += size
        if total > limit:
            raise RecordingError(
                f"{path}:{key}",
                f"a declared size of {size} bytes ({total} with those before) in a file of {there} bytes",
                f"at most {limit}",
                "exporting it again: the file is damaged, or made to fill the memory",
            )


def _npz_content(
    path: Path, archive: zipfile.ZipFile, groups: tuple[str, ...], root: tuple[str, ...]
) -> Content:
    members: dict[str, Stored] = {}
    others, names = [], set()
    for info in archive.infolist():
        name = info.filename.removesuffix(".npy")
        if info.filename in names:
            raise RecordingError(
                f"{path}:{name}", "the data set twice", "once", "exporting it again"
            )
        names.add(info.filename)
        head = name.split("/")[0]
        packed = name != info.filename
        # In our groups whatever is no data set is a damaged one.
        if (packed and name in root) or ("/" in name and head in groups and not info.is_dir()):
            members[name] = _npz_stored(path, archive, info)
        else:
            # Where the directory and the member itself have different names, a name of ours may be damaged.
            archive.open(info).close()
            others.append(name)
    check_sizes(path, members)
    attributes = {n: _text(path, n, members.pop(n)) for n in list(members) if n in root or "@" in n}
    return Content(members, attributes, others)


def _npz_stored(path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> Stored:
    name = info.filename.removesuffix(".npy")
    with archive.open(info) as file:
        version = np.lib.format.read_magic(file)
        header = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }.get(version)
        if header is None:
            raise RecordingError(
                f"{path}:{name}", f"version {version} of NPY", "1.0 or 2.0", "exporting it again"
            )
        shape, fortran, dtype = header(file)
        start = file.tell()
    if dtype.hasobject:
        got = f"the type {dtype}: pickled objects, which are never loaded"
        expected = "numbers, flags or texts"
        raise RecordingError(f"{path}:{name}", got, expected, "exporting it again as such")
    size = dtype.itemsize * math.prod(shape)
    if min(shape, default=0) < 0 or info.file_size != start + size:
        got = f"{info.file_size - start} bytes of data"
        expected = f"{size} for the shape {shape} of {dtype}"
        raise RecordingError(f"{path}:{name}", got, expected, "copying or exporting it again")

    def read() -> NDArray[Any]:
        with archive.open(info) as file:
            # To the end, so that the check sum is compared.
            data = file.read()[start:]
        array = np.frombuffer(data, dtype, math.prod(shape)) if size else np.empty(shape, dtype)
        return array.reshape(shape, order="F" if fortran else "C")

    return Stored(dtype, shape, read)


def _hdf5_content(
    path: Path, file: h5py.File, groups: tuple[str, ...], root: tuple[str, ...]
) -> Content:
    arrays: dict[str, Stored] = {}
    attributes = {key: _attribute(path, file, key) for key in root if key in file.attrs}
    others = [str(name) for name in file if name not in groups]
    for group in (name for name in groups if name in file):
        node = _follow(path, file, group, h5py.Group, "a group")
        for name in node:
            key = f"{group}/{name}"
            data = _follow(path, node, name, h5py.Dataset, "a data set", key)
            arrays[key] = _hdf5_stored(path, key, data)
            for about in ("unit", "frame"):
                if about in data.attrs:
                    attributes[f"{key}@{about}"] = _attribute(path, data, about, key)
    check_sizes(path, arrays)
    return Content(arrays, attributes, others)


def _follow(path: Path, node: Any, name: str, kind: type, wanted: str, key: str = "") -> Any:
    """A group or data set of this file; links to other files are not followed."""
    place, link = f"{path}:{key or name}", node.get(name, getlink=True)
    if not isinstance(link, h5py.HardLink):
        got = f"a link ({type(link).__name__})"
        hint = "copying what it leads to into the file (h5repack, h5copy)"
        raise RecordingError(place, got, f"{wanted} in the file itself", hint)
    found = node[name]
    if not isinstance(found, kind):
        raise RecordingError(
            place, type(found).__name__, wanted, "another layout (see docs/formats.md)"
        )
    return found


def _hdf5_stored(path: Path, key: str, data: Any) -> Stored:
    place = f"{path}:{key}"
    if data.is_virtual or data.external:
        raise RecordingError(place, "data in other files", "data in the file itself", "h5repack")
    filters = data.id.get_create_plist()
    for i in range(filters.get_nfilters()):
        number, _, _, name = filters.get_filter(i)
        if not h5py.h5z.filter_avail(number):
            raise RecordingError(
                place,
                f"data packed by filter {number} ({name.decode('utf-8', 'replace')}), which is not there",
                "gzip, or no packing",
                "h5repack -f GZIP=4",
            )
    if data.shape is None:
        raise RecordingError(place, "no data", "an array", "exporting it again")
    if data.chunks:
        chunk = Stored(data.dtype, data.chunks, data.__getitem__)
        check_sizes(path, {key: chunk})
    _refuse_objects(place, data.dtype)
    text = h5py.check_string_dtype(data.dtype) is not None
    return Stored(
        data.dtype, data.shape, lambda: np.asarray(data.asstr()[()] if text else data[()])
    )


def _attribute(path: Path, node: Any, name: str, key: str = "") -> Any:
    found = node.attrs.get_id(name)
    place = f"{path}:{key}@{name}"
    _refuse_objects(place, found.dtype)
    stored = Stored(found.dtype, found.shape, lambda: np.asarray(node.attrs[name]))
    return _text(path, f"{key}@{name}", stored)


def _refuse_objects(place: str, dtype: np.dtype) -> None:
    """Only texts may be of any length: the HDF5 library itself crashes on some other types in a damaged
    file."""
    if dtype.hasobject and h5py.check_string_dtype(dtype) is None:
        raise RecordingError(
            place, "a type of references or lists", "numbers, flags or texts", "exporting it again"
        )


def _text(path: Path, key: str, stored: Stored) -> Any:
    """A single text or whole number, which is all that attributes are read for."""
    if math.prod(stored.shape) == 1 and stored.dtype.kind in "USOiu":
        value = stored.read().reshape(-1)[0]
        value = value.decode() if isinstance(value, bytes) else value
        if isinstance(value, str):
            value.encode()
            return str(value)
        if isinstance(value, np.integer):
            return int(value)
    got = f"{stored.dtype} of shape {stored.shape}"
    raise RecordingError(f"{path}:{key}", got, "one text or whole number", "writing it as such")


def of_fixed_length(value: Any) -> Any:
    """Texts as HDF5 holds them in place: texts of any length are in a heap, in which the library may
    get lost where the file is damaged."""
    if not isinstance(value, str | tuple):
        return value
    coded = value.encode() if isinstance(value, str) else [text.encode() for text in value]
    longest = len(coded) if isinstance(coded, bytes) else max(map(len, coded))
    return np.array(coded, h5py.string_dtype("utf-8", max(longest, 1)))
