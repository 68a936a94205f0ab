"""docs/performance.md from the measurements: its pictures, and its tables between markers."""

import re
import sys

import pandas as pd

from benchmarks import pictures, tables, wrapper
from benchmarks.settings import ROOT, Scale
from benchmarks.summaries import paper_budget, speed_summary


def measure_all(scale: Scale) -> None:
    """Write the document and the pictures of the data in `scale.data`, and summary.csv."""
    names = ("results", "breakdown", "growth", "workflow", "planning", "start", "wrapper")
    names += ("purejaxrl", "arithmetic", "update")
    if missing := [name for name in names if not (scale.data / f"{name}.csv").exists()]:
        sys.exit(f"report: not measured yet: {', '.join(missing)} (in {scale.data})")
    data = [pd.read_csv(scale.data / f"{name}.csv") for name in names]
    results, times, growth, jobs, planning, starts, costs, peers, prices, one_update = data
    summary = speed_summary(results)
    summary.to_csv(scale.data / "summary.csv", index=False)
    pictures.draw_speed(summary, scale)
    pictures.draw_breakdown(times, scale)
    pictures.draw_growth(growth, scale)
    study, plan = paper_budget(results, jobs), planning.iloc[0]
    found = {
        "machine": tables.machine(results),
        "goals": tables.goals(results, growth, jobs, study, plan),
        "speed": tables.speed_table(summary),
        "steps": tables.steps_table(summary),
        "memory": tables.memory_table(jobs),
        "breakdown": tables.breakdown_table(times),
        "growth": tables.growth_table(growth),
        "workflow": tables.workflow_table(study, plan),
        "start": tables.start_table(starts),
        "wrapper": wrapper.table(costs),
        "purejaxrl": tables.purejaxrl_tables(peers),
        "arithmetic": tables.arithmetic_table(prices),
        "update": tables.update_table(one_update),
    }
    text = filled((ROOT / "docs" / "performance.md").read_text(encoding="utf-8"), found)
    scale.document.write_text(text, encoding="utf-8")
    print(found["goals"], f"\nAll tables: {scale.document}")


def filled(text: str, tables: dict[str, str]) -> str:
    """`text` with every `<!-- NAME -->` … `<!-- end of NAME -->` holding its table."""
    for name, table in tables.items():
        begin, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->\n"
        pattern = re.escape(begin) + ".*?" + re.escape(end)
        replacement = f"{begin}\n{table}\n\n{end}"
        text, found = re.subn(pattern, lambda _, new=replacement: new, text, flags=re.DOTALL)
        if found != 1:
            raise ValueError(f"the document has {found} places for {name!r}, but should have 1")
    return text
