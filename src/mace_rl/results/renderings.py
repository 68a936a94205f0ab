"""A table as Markdown, HTML, LaTeX and plain text: renderings of one frame of cells (`tables`)."""

import html
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

DASH = "\u2013"  # in the place of a number that there is not
COLUMNS_PER_BLOCK = 3  # of LaTeX's tables, side by side; more continue below

_LATEX = str.maketrans(  # escapes stand for letters that look like Latin ones
    {character: f"\\{character}" for character in "&%$#_{}"}
    | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    | {"<": "$<$", ">": "$>$", "|": "$|$", "±": r"$\pm$", "\u00d7": r"$\times$", "−": "$-$"}
    | {"\u2013": "--", "\u2014": "---", "₀": "$_0$", "≤": r"$\leq$", "≥": r"$\geq$"}
    | {"\u03b1": r"$\alpha$", "β": r"$\beta$", "\u03b3": r"$\gamma$", "δ": r"$\delta$"}
    | {"ε": r"$\epsilon$", "ϵ": r"$\epsilon$", "η": r"$\eta$", "θ": r"$\theta$"}
    | {"λ": r"$\lambda$", "μ": r"$\mu$", "\u03c3": r"$\sigma$", "τ": r"$\tau$"}
    | {"\U0001d43e": "$K$", "⁻": "$^-$"}
    | {power: f"$^{digit}$" for digit, power in enumerate("⁰\u00b9\u00b2\u00b3⁴⁵⁶⁷⁸⁹")}
)


class Value(NamedTuple):
    """One number, or words, as printed."""

    text: str
    low: str = ""  # of its interval; empty where none is asked for
    high: str = ""
    mark: str = ""  # †, and of how many seeds
    best: bool = False


class Cell(NamedTuple):
    """Several values in one cell, and what is to be said beside them. (One word is a `str`.)"""

    values: Sequence[Value]
    joint: str = " / "
    note: str = ""


def number(value: float | None, digits: int = 0) -> str:
    """A number with a true minus, and without one before a zero; a dash where there is none."""
    if value is None or np.isnan(value):
        return DASH
    return f"{value:z.{digits}f}".replace("-", "−")


def estimate(
    value: float | None,
    low: float | None,
    high: float | None,
    digits: int = 0,
    mark: str = "",
    best: bool = False,
) -> Value:
    """A number with its interval, of dashes where there is none."""
    text, start, end = (number(one, digits) for one in (value, low, high))
    return Value(text, start, end, mark, best)


def markdown(frame: pd.DataFrame) -> str:
    """A table as Markdown."""
    lines = [f"| {' | '.join(map(_markdown, frame.columns))} |", "|---" * len(frame.columns) + "|"]
    lines += [f"| {' | '.join(map(_markdown, row))} |" for row in frame.to_numpy()]
    return "\n".join(lines) + "\n"


def _markdown(cell: str | Cell) -> str:
    if isinstance(cell, str):
        return cell.replace("|", "\\|")
    texts = (f"**{one.text}{one.mark}**" if one.best else one.text + one.mark for one in cell[0])
    intervals = [f"{one.low} to {one.high}" for one in cell.values if one.low]
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
    return cell.joint.join(f"{one.text}{one.mark}{'*' if one.best else ''}" for one in cell.values)


def as_html(frame: pd.DataFrame) -> str:
    """A table as HTML, for the style sheet of the report: words left, numbers right."""
    rows = [[_html(cell) for cell in row] for row in frame.to_numpy()]
    words = [all(isinstance(cell, str) for cell in frame.iloc[:, i]) for i in range(len(frame.T))]

    def line(tag: str, cells: Sequence[str]) -> str:
        left = [' class="left"' if word else "" for word in words]
        whole = "".join(f"<{tag}{x}>{cell}</{tag}>" for x, cell in zip(left, cells, strict=True))
        return f"<tr>{whole}</tr>"

    head = line("th", [html.escape(name) for name in frame.columns])
    body = [line("td", row) for row in rows]
    lines = ["<thead>", head, "</thead>", "<tbody>", *body, "</tbody>"]
    return '<div class="scroll"><table class="data">' + "\n".join(lines) + "</table></div>"


def _html(cell: str | Cell) -> str:
    if isinstance(cell, str):
        return html.escape(cell)
    texts = [
        f'<span class="nowrap{" best" if one.best else ""}">{html.escape(one.text)}'
        f"<sup>{one.mark}</sup></span>"
        for one in cell.values
    ]
    intervals = [f"{one.low} to {one.high}" for one in cell.values if one.low]
    below = [cell.joint.join(intervals), html.escape(cell.note)]
    return cell.joint.join(texts) + "".join(f"<small>{line}</small>" for line in below if line)


def escaped(text: str) -> str:
    """`text` with LaTeX's special characters escaped and symbols such as β in math mode."""
    return text.translate(_LATEX)


def latex_float(caption: str, label: str, frame: pd.DataFrame) -> str:
    """A table for \\input, as wide as the page; it needs the package booktabs and nothing else.

    The columns beyond `COLUMNS_PER_BLOCK` go into tabulars below.
    """
    head, *names = frame.columns
    starts = range(0, len(names), COLUMNS_PER_BLOCK)
    blocks = [names[start : start + COLUMNS_PER_BLOCK] for start in starts]
    lines = [
        r"\begin{table*}[tbp]",
        r"\centering",
        rf"\caption{{{caption}}}",
        rf"\label{{{label}}}",
        r"\par\medskip",
        r"\footnotesize",
        r"\setlength{\tabcolsep}{2pt}",
        "\n\\par\\medskip\n".join(_tabular(frame[[head, *block]]) for block in blocks),
        r"\end{table*}",
    ]
    return "\n".join(lines) + "\n"


def _tabular(frame: pd.DataFrame) -> str:
    """A tabular of \\textwidth."""
    columns = r"p{0.23\textwidth}" + "c" * (len(frame.columns) - 1)
    names = [lines[0] if len(lines) == 1 else stack(*lines) for lines in map(_name, frame.columns)]
    rows = [
        [r"\newline ".join(_name(name)), *map(latex_cell, cells)]
        for name, *cells in frame.to_numpy()
    ]
    lines = [
        rf"\begin{{tabular*}}{{\textwidth}}{{@{{\extracolsep{{\fill}}}}{columns}@{{}}}}",
        r"\toprule",
        " & ".join(names) + r" \\",
        r"\midrule",
        "\n\\addlinespace\n".join(rf"\raggedright {' & '.join(row)} \\" for row in rows),
        r"\bottomrule",
        r"\end{tabular*}",
    ]
    return "\n".join(lines)


def latex_cell(cell: str | Cell) -> str:
    """A cell: its values, and their intervals below."""
    if isinstance(cell, str):
        return escaped(cell)
    texts = []
    for one in cell.values:
        text = rf"\textbf{{{escaped(one.text)}}}" if one.best else escaped(one.text)
        dagger = one.mark.replace("†", r"\dagger")
        texts.append(text + (f"$^{{{dagger}}}$" if dagger else ""))
    if not any(one.low for one in cell.values):
        return stack(*texts, align="l")
    ends = (
        "--" if one.low == DASH else rf"[{escaped(one.low)},\,{escaped(one.high)}]"
        for one in cell.values
    )
    return stack(cell.joint.join(texts), rf"{{\scriptsize {'/'.join(ends)}}}")


def stack(*lines: str, align: str = "c") -> str:
    """Lines of LaTeX below one another in one cell."""
    return rf"\begin{{tabular}}[t]{{@{{}}{align}@{{}}}}" + r"\\".join(lines) + r"\end{tabular}"


def _name(name: str) -> list[str]:
    """A variant's name in LaTeX, what is in parentheses on a line of its own."""
    return escaped(name).replace(" (", "\n(", 1).split("\n")
