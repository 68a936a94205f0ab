"""Where the time of a training goes, measured by wrapping functions from outside."""

import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any


class Stopwatch:
    """Seconds by section. Sections nest: the inner one's time is not the outer one's."""

    def __init__(self, section: str) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._sections = [section]  # the innermost last
        self._since = time.perf_counter()

    def wrapped(self, section: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """`function`, with the time spent in it booked on `section`."""

        def timed(*arguments: Any, **keywords: Any) -> Any:
            self._book()
            self._sections.append(section)
            try:
                return function(*arguments, **keywords)
            finally:
                self._book()
                self._sections.pop()

        return timed

    def wrap(self, section: str, owner: Any, name: str) -> None:
        """Replace the function `owner.name` by its wrapped self."""
        setattr(owner, name, self.wrapped(section, getattr(owner, name)))

    def stop(self) -> dict[str, float]:
        """Seconds by section until now."""
        self._book()
        return dict(self.seconds)

    def _book(self) -> None:
        now = time.perf_counter()
        self.seconds[self._sections[-1]] += now - self._since
        self._since = now
