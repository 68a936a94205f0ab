"""The ledger: what came out of each claim and of each of its parts; claims.json has it."""

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from mace_rl.base.tables import RecordError


@dataclass(frozen=True)
class Finding:
    """What was found of one part; differences count in the claim's favour."""

    environments: tuple[str, ...]
    metric: str
    variant: str
    baseline: str | None
    unit: str  # episodes, return, correlation, or a share of everything
    seeds: int  # in the environment that has fewest
    difference: float
    low: float
    high: float
    p_value: float
    probability: float  # that a run of the variant is better than one of the baseline
    probability_low: float
    probability_high: float
    detectable: float  # what these seeds show with a power of `POWER`, before correction
    worth_mentioning: float
    in_paper: float  # the same difference in the paper's Table 1; NaN where that has none
    p_equivalent: float  # that the difference is not smaller than what is worth mentioning
    p_holm: float = math.nan
    p_equivalent_holm: float = math.nan
    outcome: str = ""  # shown, reversed, no_room, absent or open
    size: str = ""  # worth mentioning, small or open
    room: float = math.nan  # how much better than the baseline a run could be at most
    predicted_low: float = math.nan  # of where a mean of ours may lie if the paper's one run each
    predicted_high: float = math.nan  # differs by chance
    replication: str = ""  # agrees, within one seed's chance, disagrees; empty without a number

    @property
    def has_room(self) -> bool:
        """Whether there could be a difference worth mentioning."""
        return self.room >= self.worth_mentioning


@dataclass(frozen=True)
class Judgement:
    """What came out of a claim, measured in one way."""

    outcome: str
    verdict: str  # the same in the words of its family
    parts: list[Finding]


@dataclass(frozen=True)
class Answer:
    """A claim, and what came out of it in each way to measure it."""

    family: str
    claim: str
    statement: str
    paper: str  # what the paper's own table says of it; empty where it says nothing
    ways: Mapping[str, Judgement]


def to_json(cost: Mapping[str, Any], answers: Iterable[Answer]) -> str:
    """claims.json, in which NaN is null and each way a key of its claim."""
    records = []
    for answer in answers:
        record = asdict(answer)
        record |= record.pop("ways")
        for how in answer.ways:
            for part in record[how]["parts"]:
                part |= {key: None for key, value in part.items() if value != value}
        records.append(record)
    whole = {"cost": cost, "claims": records}
    return json.dumps(whole, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def read_ledger(path: str | Path) -> list[Answer]:
    """What `to_json` wrote; `RecordError` if it never did."""
    try:
        return [_answer(record) for record in json.loads(Path(path).read_bytes())["claims"]]
    except (ValueError, LookupError, TypeError, AttributeError):
        raise RecordError(f"{path}: not as the workflow writes it") from None


def _answer(record: dict[str, Any]) -> Answer:
    own = {field.name: record.pop(field.name) for field in fields(Answer) if field.name in record}
    return Answer(**own, ways={how: _judgement(**judged) for how, judged in record.items()})


def _judgement(outcome: str, verdict: str, parts: list[dict[str, Any]]) -> Judgement:
    for part in parts:
        part["environments"] = tuple(part["environments"])
        missing = [key for key, value in part.items() if value is None and key != "baseline"]
        part |= dict.fromkeys(missing, math.nan)
    return Judgement(outcome, verdict, [Finding(**part) for part in parts])
