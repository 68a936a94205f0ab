"""What the user can mend: a base for the errors that get one line instead of a traceback."""

import traceback
from types import FrameType


class Refusal(Exception):
    """Something cannot be done as it was asked for; the message says what and why, in one line."""


def raised_in(error: BaseException) -> tuple[FrameType, str]:
    """The frame that raised `error`, which has a traceback, and its place, "file:line"."""
    *_, (frame, line) = traceback.walk_tb(error.__traceback__)
    return frame, f"{frame.f_code.co_filename}:{line}"


def in_one_line(error: BaseException) -> str:
    """Its type and text and, where the user's code raised it, the place."""
    frame, place = raised_in(error)
    own = frame.f_globals.get("__name__", "").startswith(("mace_rl.", "importlib."))
    return " ".join(f"{type(error).__name__}: {error}{'' if own else f' ({place})'}".split())
