"""Tables as text: pages of Markdown, such as claims.md and tables.md, and for the terminal."""

from collections.abc import Iterable, Sequence

import pandas as pd

from mace_study.show.sections import Section
from mace_study.show.tables import COLUMNS_PER_BLOCK, Cell


def page(title: str, origin: str, sections: Iterable[Section], pictures: Sequence[str] = ()) -> str:
    """A page of pictures (PNG files beside it) and sections; `origin` says how it was made."""
    text = f"# {title}\n\n{origin}\n"
    text += "".join(f"\n![{name}]({name}.png)\n" for name in pictures)
    for section in sections:
        note = f"{section.note}\n\n" if section.note else ""
        text += f"\n{'#' * section.level} {section.title}\n\n{note}{markdown(section.frame)}"
    return text


def markdown(frame: pd.DataFrame) -> str:
    """A table as Markdown."""
    lines = [f"| {' | '.join(map(_markdown, frame.columns))} |", "|---" * len(frame.columns) + "|"]
    lines += [f"| {' | '.join(map(_markdown, row))} |" for row in frame.to_numpy()]
    return "\n".join(lines) + "\n"


def _markdown(cell: str | Cell) -> str:
    if isinstance(cell, str):
        return cell.replace("|", "\\|")
    texts = (
        f"**{value.text}{value.mark}**" if value.best else value.text + value.mark
        for value in cell[0]
    )
    intervals = [f"{value.low} to {value.high}" for value in cell.values if value.low]
    interval = f" ({cell.joint.join(intervals)})" if intervals else ""
    return cell.joint.join(texts) + interval + (f"; {cell.note}" if cell.note else "")


def plain(frame: pd.DataFrame) -> str:
    """A table for the terminal, without intervals; the best have a star."""
    head, *names = frame.columns
    blocks = []
    for start in range(0, len(names), COLUMNS_PER_BLOCK):
        part = frame[[head, *names[start : start + COLUMNS_PER_BLOCK]]]
        rows = [list(part.columns), *([_plain(cell) for cell in row] for row in part.to_numpy())]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        blocks.append("\n".join("   ".join(map(str.ljust, row, widths)).rstrip() for row in rows))
    return "\n\n".join(blocks)


def _plain(cell: str | Cell) -> str:
    if isinstance(cell, str):
        return cell
    return cell.joint.join(
        f"{value.text}{value.mark}{'*' if value.best else ''}" for value in cell.values
    )
