"""The first study's parts, judged by the protocol's rule: kept beside the confirmation's.

    .venv/bin/python -m tools.first_study reference/measured/first_study.json

All parts of the paper's claims, and those of our questions whose environments it had, corrected
together as far as they go. The records are those of claims.json.
"""

import json
import sys
from dataclasses import replace
from pathlib import Path

from mace_rl.config.study import read_study
from mace_rl.results.claims import ledger
from mace_rl.results.protocol import DISTRACTING, FAMILIES, ROBUST, Claim
from tools.power import first_study

NEW = set(DISTRACTING[1:])


def main() -> None:
    """Entry point."""
    settings = read_study([Path("config.yaml"), Path("config/questions.yaml")]).metrics
    table = first_study(settings.moving_average)
    table = table[~table["env"].isin(NEW) & (table["seed"] < 20)]

    def had(claim: Claim) -> Claim:
        parts = [part for part in claim.parts[ROBUST] if not NEW & set(part.environments)]
        return replace(claim, parts={ROBUST: tuple(parts)})

    papers, own = FAMILIES
    asked = [claim for claim in map(had, own.claims) if claim.parts[ROBUST]]
    records = ledger(table, settings, [papers, replace(own, claims=tuple(asked))])
    text = json.dumps(records, indent=1, ensure_ascii=False, allow_nan=False)
    Path(sys.argv[1]).write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
