"""What `torch.save` writes, to the byte, without torch: it takes seconds and 200 MB to import.

The file is a zip archive of a pickle, which names functions and types of torch, and of the numbers
of each tensor. A test compares it with `torch.save`.
"""

import io
import pickle
import struct
import zlib
from collections import OrderedDict
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from mace_rl.base.state import SavedArray

ALIGNED = 64  # contents in the archive begin at multiples of this
# How many buckets a hash table of libstdc++ has as it grows.
BUCKETS = (13, 29, 59, 127, 257, 541, 1109, 2357, 5087, 10273, 20753, 42043, 85229)


def _rebuild_tensor_v2() -> None:
    """Stands for torch's, of whose name pickle writes no more than it finds here."""


# Like it, torch's types of storages.
STORAGES = {
    np.dtype(name): type(f"{storage}Storage", (), {})
    for name, storage in {
        "float64": "Double",
        "float32": "Float",
        "int64": "Long",
        "int32": "Int",
        "uint8": "Byte",
        "bool": "Bool",
    }.items()
}
globals().update({storage.__name__: storage for storage in STORAGES.values()})


def archive(content: Any) -> bytes:
    """`torch.save` of plain data, every `SavedArray` in it as a tensor.

    Raises `KeyError` for arrays of a type not in `STORAGES`, `OverflowError` for 4 GiB and more.
    """
    buffer = io.BytesIO()
    pickler = _Pickler(buffer, protocol=2)
    pickler.dump(content)
    here = f"c{__name__}\n".encode()  # before each name; what follows does not depend on its length
    pickled = buffer.getvalue().replace(here + b"_rebuild", b"ctorch._utils\n_rebuild")
    members = {
        "data.pkl": pickled.replace(here, b"ctorch\n"),
        ".format_version": b"1",
        ".storage_alignment": str(ALIGNED).encode(),
        "byteorder": b"little",
        **{f"data/{key}": array.tobytes() for key, array in enumerate(pickler.arrays)},
        "version": b"3\n",
    }
    if sum(map(len, members.values())) >= 2**32 - 2**28 or len(members) > BUCKETS[-1]:
        raise OverflowError("too large for the form of archives that this module writes")
    return _zipped(members)


class _Storage:
    """The numbers of an array, which are not in the pickle."""

    def __init__(self, array: np.ndarray) -> None:
        self.array = array


class _Pickler(pickle.Pickler):
    def __init__(self, file: io.BytesIO, protocol: int) -> None:
        super().__init__(file, protocol)
        self.arrays: list[np.ndarray] = []

    def persistent_id(self, value: Any) -> Any:
        if type(value) is not _Storage:
            return None
        key = str(len(self.arrays))
        self.arrays.append(value.array)
        return "storage", STORAGES[value.array.dtype], key, "cpu", value.array.size

    def reducer_override(self, value: Any) -> Any:
        if type(value) is not SavedArray:
            return NotImplemented
        array = np.ascontiguousarray(value).reshape(value.shape)
        strides = tuple(stride // array.itemsize for stride in array.strides)
        hooks: OrderedDict[str, Any] = OrderedDict()
        return _rebuild_tensor_v2, (_Storage(array), 0, array.shape, strides, False, hooks)


def _zipped(members: dict[str, bytes]) -> bytes:
    """As torch's writer zips: not compressed, aligned, and a digest of the others as last file."""
    names = _combined(map(_hash, _as_a_set(members)))
    sums = _combined(zlib.crc32(content) for content in members.values() if content)
    members = {**members, ".data/serialization_id": f"{names:020d}{sums:020d}".encode()}
    body, directory = bytearray(), bytearray()
    for name, content in members.items():
        label, start, size = f"archive/{name}".encode(), len(body), len(content)
        sizes = struct.pack("<3I", zlib.crc32(content), size, size)
        flags = 0x0808 if content else 0x0800  # a descriptor follows; the name is UTF-8
        fill = -(start + 30 + len(label) + 4) % ALIGNED
        body += struct.pack("<4s2H18x2H", b"PK\x03\x04", 0, flags, len(label), 4 + fill)
        body += label + struct.pack("<2sH", b"FB", fill) + fill * b"Z" + content
        body += b"PK\x07\x08" + sizes if content else b""
        directory += struct.pack("<4s2HH6x", b"PK\x01\x02", 0, 0, flags) + sizes
        directory += struct.pack("<H12xI", len(label), start) + label
    count, size, start = len(members), len(directory), len(body)
    end = struct.pack("<4sQ2H8x4Q", b"PK\x06\x06", 44, 0x31E, 45, count, count, size, start)
    end += struct.pack("<4s4xQI", b"PK\x06\x07", start + size, 1)
    end += struct.pack("<4s4x2H2I2x", b"PK\x05\x06", count, count, size, start)
    return bytes(body + directory + end)


def _as_a_set(names: Iterable[str]) -> Iterator[bytes]:
    """In the order in which C++ goes through a `std::unordered_set` that they are put into.

    The bucket that was filled last comes first, and in each the name that came last.
    """
    growth, count, buckets = iter(BUCKETS), 0, dict[int, list[bytes]]()

    def in_order() -> Iterator[bytes]:
        for bucket in reversed(buckets.values()):
            yield from reversed(bucket)

    for place, name in enumerate(names):
        added = [name.encode()]
        if place == count:
            count, added = next(growth), [*in_order(), *added]
            buckets.clear()
        for each in added:
            buckets.setdefault(_hash(each) % count, []).append(each)
    return in_order()


def _combined(hashes: Iterable[int]) -> int:
    """Several hashes as one, 64 bits (boost's `hash_combine`)."""
    result = 0
    for value in hashes:
        result ^= (value + 0x9E3779B9 + (result << 6) + (result >> 2)) % 2**64
    return result


def _hash(text: bytes) -> int:
    """`std::hash<std::string>` of libstdc++, MurmurHash64A."""
    factor, whole = 0xC6A4A7935BD1E995, len(text) // 8 * 8

    def mixed(value: int) -> int:
        return value ^ value >> 47

    result = 0xC70F6907 ^ len(text) * factor % 2**64
    for start in range(0, whole, 8):
        word = int.from_bytes(text[start : start + 8], "little")
        result = (result ^ mixed(word * factor % 2**64) * factor) * factor % 2**64
    if rest := text[whole:]:
        result = (result ^ int.from_bytes(rest, "little")) * factor % 2**64
    return mixed(mixed(result) * factor % 2**64)
