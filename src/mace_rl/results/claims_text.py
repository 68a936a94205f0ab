"""The claim ledger as claims.json and claims.md have it, from the records of `claims.ledger`."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

from mace_rl.results.claims import LITERAL, POWER, ROBUST


def as_json(records: Sequence[Mapping[str, Any]], cost: Mapping[str, Any]) -> str:
    """The data of claims.json: what it cost, then the records of `ledger`."""
    whole = {"cost": cost, "claims": records}
    return json.dumps(whole, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def markdown(records: Sequence[Mapping[str, Any]], origin: str) -> str:
    """The ledger to read: a table of verdicts, then every part; `origin` says how it was made."""
    lines = [
        "# Does it hold?",
        "",
        f"{origin} The rule of the verdicts: docs/method.md.",
        "",
        f"| | claim | {LITERAL} | {ROBUST} | the paper's Table 1 |",
        "|---|---|---|---|---|",
    ]
    for record in records:
        verdicts = " | ".join(f"**{record[how]['verdict']}**" for how in (LITERAL, ROBUST))
        lines.append(
            f"| {record['claim']} | {record['statement']} | {verdicts} | {record['paper']} |"
        )
    for how in (LITERAL, ROBUST):
        lines += [
            "",
            f"## Part by part: {how}",
            "",
            "Differences count in the claim's favour, and so does *paper*, the same in its Table 1."
            " *P*: that a run of the first is better. *Margin*: what counts as an advantage worth"
            f" mentioning. *Detectable*: the smallest that these seeds show with a power of"
            f" {POWER:.0%}, before correction.",
            "",
            *parts_table(records, how),
        ]
    return "\n".join(lines) + "\n"


def parts_table(records: Sequence[Mapping[str, Any]], how: str) -> list[str]:
    """Every part of every claim, measured in one of the two ways, as lines of Markdown."""
    columns = ["", "environment", "metric", "over", "n", "difference", "p (Holm)", "P", "paper"]
    columns += ["margin", "detectable", ""]
    lines = [f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    for record in records:
        for part in record[how]["parts"]:
            lines.append(f"| {' | '.join([record['claim'], *_cells(part)])} |")
    return lines


def digits_of(part: Mapping[str, Any]) -> int:
    """How many digits after the point the numbers of a part are shown with."""
    return {"episodes": 0, "return": 1}.get(part["unit"], 3)


def _cells(part: Mapping[str, Any]) -> list[str]:
    """What the table has of one part."""
    digits = digits_of(part)
    names = ("difference", "low", "high", "in_paper", "worth_mentioning", "detectable")
    difference, low, high, paper, margin, detectable = (_shown(part[x], digits) for x in names)
    chance = [_shown(part[f"probability{end}"], 2) for end in ("", "_low", "_high")]
    return [
        "all" if len(part["environments"]) > 1 else part["environments"][0],
        part["metric"],
        f"{part['variant']} over {part['baseline'] or '0'}",
        str(part["seeds"]),
        f"{difference} ({low} to {high})",
        _shown(part["p_holm"], 3),
        f"{chance[0]} ({chance[1]} to {chance[2]})",
        paper,
        margin,
        detectable,
        part["outcome"],
    ]


def _shown(value: float | None, digits: int) -> str:
    """A number with a true minus, and without one before a zero; a dash where there is none."""
    return "–" if value is None else f"{value:z.{digits}f}".replace("-", "−")
