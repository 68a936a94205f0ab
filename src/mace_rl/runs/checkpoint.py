"""Checkpoints and agents on disk: written atomically, read without executing anything.

A checkpoint is `sha256 of the rest, newline, torch archive`. It has the identity of its run
(configuration, code, versions), and no other run continues it.
"""

import hashlib
import io
import sys
import zipfile
from collections import OrderedDict
from contextlib import suppress
from pathlib import Path
from typing import Any

from mace_rl.base import files
from mace_rl.base.errors import Refusal
from mace_rl.base.files import write_atomically
from mace_rl.base.state import SavedArray
from mace_rl.config.section import short_repr
from mace_rl.runs import torch_archive

PLAIN = (SavedArray, bool, int, float, str, type(None), list, tuple, dict, OrderedDict)


class CheckpointError(Refusal, ValueError):
    """A file that is damaged or belongs to another run; the message names it and says why."""


def archive(content: dict[str, Any]) -> bytes:
    """Tensors, numbers, strings, lists and dicts as a torch archive; equal content, equal bytes."""
    content, buffer = _unshared(content), io.BytesIO()
    if "torch" not in sys.modules:  # so there are no tensors but `SavedArray`s
        with suppress(KeyError, OverflowError):
            return torch_archive.archive(content)
    import torch

    torch.save(content, buffer)
    return buffer.getvalue()


def _unshared(content: Any) -> Any:
    """The same with one object for equal strings, and different ones for lists and dictionaries.

    Pickle writes the same object again as a reference, but an equal one in full.
    """
    kind = type(content)
    if kind is dict:
        return {_unshared(key): _unshared(value) for key, value in content.items()}
    if kind is list or kind is tuple:
        return kind(map(_unshared, content))
    return sys.intern(content) if kind is str else content


def unarchive(data: bytes, origin: Path) -> dict[str, Any]:
    """Read what `archive` wrote; only plain data, not compressed, is accepted (`weights_only`)."""
    import torch

    try:
        with zipfile.ZipFile(io.BytesIO(data)) as members:
            if sum(member.file_size for member in members.infolist()) > len(data):
                raise ValueError("it is compressed")
        return dict(torch.load(io.BytesIO(data), weights_only=True))
    except Exception as error:  # torch raises many types
        # The first sentence: PyTorch goes on with advice to trust the file, in colours.
        reason = str(error).splitlines()[0].partition(". ")[0] if str(error) else repr(error)
        raise CheckpointError(f"{origin}: not a readable archive: {reason}") from error


def require_plain(value: Any, place: str) -> None:
    """`CheckpointError`, with the `place`, if `unarchive` would not read `value`."""
    torch = sys.modules.get("torch")
    tensors = (torch.Tensor, torch.nn.Parameter) if torch else ()
    if type(value) not in (*PLAIN, *tensors):
        right = "a tensor, number, text, list or dict, to be read without executing anything"
        raise CheckpointError(f"{place} is {short_repr(value)}, but should be {right}")
    pairs = value.items() if isinstance(value, dict) else ()
    for key, item in enumerate(value) if isinstance(value, list | tuple) else pairs:
        require_plain(key, f"a key of {place}")
        require_plain(item, f"{place}.{key}")


def save(path: Path, identity: dict[str, Any], state: dict[str, Any]) -> None:
    """Write a checkpoint of the run with this `identity`; `CheckpointError` if it is not plain."""
    require_plain(state, "state")
    data = archive({"identity": identity, "state": state})
    write_atomically(path, hashlib.sha256(data).hexdigest().encode() + b"\n" + data)


def read(path: Path) -> dict[str, Any]:
    """`identity` and `state` of any run's checkpoint; `CheckpointError` if it is damaged."""
    digest, _, data = files.content(path).partition(b"\n")
    if hashlib.sha256(data).hexdigest().encode() != digest:
        raise CheckpointError(f"{path}: cut off or altered (its SHA-256 does not match)")
    content = unarchive(data, path)
    if not all(isinstance(content.get(key), dict) for key in ("identity", "state")):
        raise CheckpointError(f"{path}: it has no identity or no state")
    return content
