"""README and docs say what the kept results say: the text between marks is what a command prints.

    .venv/bin/python -m tools.printed_numbers [--check]        (make numbers)

A mark is `<!-- python -m tools.show WHAT FOLDER ... -->`; its text, to `<!-- end -->`, is what that
prints. With --check nothing is written, and a text that says something else is a mistake.
"""

import argparse
import re
import sys
from collections.abc import Iterator
from pathlib import Path

from tools.show import SHOWN

ROOT = Path(__file__).resolve().parent.parent
MARK = "<!-- python -m tools.show "
# The text has no other mark in it: one whose end is missing must not swallow the next.
MARKED = re.compile(rf"{re.escape(MARK)}([^\n]*?) -->\n((?:(?!<!--).)*?)<!-- end -->", re.DOTALL)


def pages() -> Iterator[Path]:
    """Every page that may have numbers."""
    yield ROOT / "README.md"
    yield from sorted((ROOT / "docs").glob("*.md"))


def printed(command: str) -> str:
    """What `tools.show` prints with these arguments; exits with its error if it cannot."""
    what, folder, *rest = command.split()
    try:
        return "\n" + "\n".join(SHOWN[what](ROOT / folder, *rest)) + "\n\n"
    except (KeyError, OSError) as error:
        sys.exit(f"numbers: {command}: {error!r}")


def main() -> None:
    """Entry point; exits with 1 if a page says something else and --check is given."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0],
        epilog="example: python -m tools.printed_numbers --check",
    )
    parser.add_argument("--check", action="store_true", help="write nothing")
    check = parser.parse_args().check
    stale, marks = [], 0
    for page in pages():
        text = page.read_text(encoding="utf-8")
        if len(MARKED.findall(text)) != text.count(MARK):
            sys.exit(
                f"numbers: {page.relative_to(ROOT)}: not each {MARK}… --> has its <!-- end -->"
            )

        def renew(mark: re.Match[str], page: Path = page) -> str:
            nonlocal marks
            marks += 1
            new = printed(mark[1])
            if new != mark[2]:
                stale.append(f"{page.relative_to(ROOT)}: {mark[1]}")
            return f"{MARK}{mark[1]} -->\n{new}<!-- end -->"

        renewed = MARKED.sub(renew, text)
        if not check:
            page.write_text(renewed, encoding="utf-8")
    if check and stale:
        sys.exit("numbers: not what is printed (make numbers mends it): " + "; ".join(stale))
    print(f"{marks} marked texts, {len(stale)} {'differ' if check else 'renewed'}")


if __name__ == "__main__":
    main()
