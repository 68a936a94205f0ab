"""Standard output and error that end no training if a terminal, a pipe or a disk fails."""

import errno
import io
import os
import sys
from typing import Any


class Outlet(io.FileIO):
    """Descriptor 1 or 2; after its first `error` it is /dev/null."""

    error: OSError | None = None
    was_closed = False  # and is /dev/null already, which is no place for what is asked for

    def write(self, data: Any) -> int:
        if self.was_closed and not self.error:
            self.error = OSError(errno.EBADF, os.strerror(errno.EBADF))
        try:
            written: int | None = super().write(data)  # None: it would block
        except OSError as error:
            self.error, written = error, None
            os.dup2(os.open(os.devnull, os.O_WRONLY), self.fileno())
        return len(data) if written is None else written


def keep_open(descriptor: int) -> bool:
    """Open /dev/null in place of a closed descriptor: the next file would get its number.

    Returns whether it was closed.
    """
    try:
        os.fstat(descriptor)
    except OSError:
        os.dup2(os.open(os.devnull, os.O_RDWR), descriptor)
        os.set_inheritable(descriptor, True)  # dup2 does not if it got this number itself
        return True
    return False


def secure() -> None:
    """Replace `sys.stdout` and `sys.stderr` by `Outlet`s, unless the program has replaced them."""
    for descriptor, name in enumerate(("stdin", "stdout", "stderr")):
        was_closed = keep_open(descriptor)
        stream = getattr(sys, name)
        if descriptor and stream is getattr(sys, f"__{name}__"):
            outlet = Outlet(descriptor, "w", closefd=False)
            outlet.was_closed = was_closed
            encoding = stream.encoding if stream else "utf-8"
            buffer = io.BufferedWriter(outlet)
            text = io.TextIOWrapper(buffer, encoding, "backslashreplace", line_buffering=True)
            setattr(sys, name, text)
