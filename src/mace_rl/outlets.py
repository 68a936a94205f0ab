"""Standard output and error that may be closed, or that nobody reads any more.

A terminal hangs up, a pipe's reader ends, a disk fills up: what cannot be shown is dropped, since
no training should end for it.
"""

import io
import os
import sys
from typing import Any


class Outlet(io.FileIO):
    """Descriptor 1 or 2; from the first `error` on, what is written to it goes to /dev/null."""

    error: OSError | None = None

    def write(self, data: Any) -> int:
        """Returns how many bytes are done with."""
        try:
            written: int | None = super().write(data)  # None: it would have to wait
        except OSError as error:
            self.error, written = error, None
            os.dup2(os.open(os.devnull, os.O_WRONLY), self.fileno())
        return len(data) if written is None else written


def keep_open(descriptor: int) -> None:
    """/dev/null for a closed one: the next file would get its number, and what C prints in it."""
    try:
        os.fstat(descriptor)
    except OSError:
        os.dup2(os.open(os.devnull, os.O_RDWR), descriptor)
        os.set_inheritable(descriptor, True)  # which dup2 does not of a number to itself


def secure() -> None:
    """Let no `print` to `sys.stdout` or `sys.stderr` fail, unless somebody has replaced them."""
    for descriptor, name in enumerate(("stdin", "stdout", "stderr")):
        keep_open(descriptor)
        stream = getattr(sys, name)
        if descriptor and stream is getattr(sys, f"__{name}__"):
            outlet = io.BufferedWriter(Outlet(descriptor, "w", closefd=False))
            encoding = stream.encoding if stream else "utf-8"
            text = io.TextIOWrapper(outlet, encoding, "backslashreplace", line_buffering=True)
            setattr(sys, name, text)
