"""`make tables`: what is made of the kept runs is compared with what is kept, byte for byte."""

import sys
from pathlib import Path
from typing import Any

import pytest
from shared import message

from tools import tables

ROOT = Path(__file__).parents[1]


def test_tables_runs_each_script_in_a_process_of_its_own_and_hears_how_it_ended(
    tmp_path: Path,
) -> None:
    script, trace = tmp_path / "script.py", tmp_path / "trace"
    jobs, scripts = tables.fork.Pipe()
    server = tables.fork.Process(target=tables.run_scripts, args=(jobs, scripts))
    server.start()
    scripts.close()
    note = f"import os\nopen({str(trace)!r}, 'a').write(f'{{__name__}} {{os.getpid()}}\\n')\n"
    found = []
    for end in ("", "raise SystemExit(3)", "raise ValueError", "os.kill(os.getpid(), 9)"):
        script.write_text(note + end, encoding="utf-8")
        jobs.send(str(script))
        found.append(jobs.recv())
    assert found == [0, 3, 1, -9]
    names, processes = zip(*map(str.split, trace.read_text().splitlines()), strict=True)
    assert set(names) == {"__main__"} and len({*processes, str(server.pid)}) == 5
    jobs.close()  # as where Snakemake is killed
    server.join(10)
    assert server.exitcode is not None


@pytest.fixture
def studies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project of two studies, whose tables are `a.csv` and `b.csv` and are made as kept."""
    (tmp_path / "reference").mkdir()
    (tmp_path / "reference/studies.yaml").write_text("A: {outputs: [a.csv]}\nB: {outputs: [b.csv]}")
    for name, content in (("A/a.csv", "1"), ("B/b.csv", "2")):
        path = tmp_path / "reference/tables" / name
        path.parent.mkdir(parents=True)
        path.write_text(content)

    def make(name: str, study: dict[str, Any]) -> None:
        (tables.MADE / name).mkdir(parents=True)
        for output in study["outputs"]:
            content = (tables.EXPECTED / name / output).with_suffix(".csv").read_text()
            (tables.MADE / name / output).write_text(content)

    monkeypatch.chdir(tmp_path)  # and back
    monkeypatch.setattr(tables, "ROOT", tmp_path)
    monkeypatch.setattr(tables, "SHARED", ())
    monkeypatch.setattr(tables.kept_runs, "unpack", lambda kept, made: 7)
    monkeypatch.setattr(
        tables, "make_all", lambda found: [make(name, found[name]) for name in found]
    )
    return tmp_path


def tabulate(monkeypatch: pytest.MonkeyPatch, *words: str) -> None:
    monkeypatch.setattr("sys.argv", ["tables", *words])
    tables.main()


def test_tables_that_are_as_kept(
    studies: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stale = studies / "results/tables/B/old"
    stale.parent.mkdir(parents=True)
    stale.touch()
    tabulate(monkeypatch, "--check")
    said = "2 tables and figures of 2 studies from 7 runs, in results/tables\n"
    assert capsys.readouterr().out == said and not stale.exists()


@pytest.mark.parametrize("content", ["3", "22", "", None])
def test_a_table_that_is_not_as_kept_is_named(
    content: str | None, studies: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_all = tables.make_all

    def make_another(found: dict[str, Any]) -> None:
        make_all(found)
        kept = studies / "reference/tables/B/b.csv"
        kept.unlink() if content is None else kept.write_text(content)

    monkeypatch.setattr(tables, "make_all", make_another)
    said = message(monkeypatch, tables, "--check")
    assert said == "tables: not those that are kept: reference/tables/B/b.csv"


def test_a_new_table_is_kept_unless_it_is_to_be_checked(
    studies: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    kept = studies / "reference/tables/B/b.csv"
    make_all = tables.make_all

    def make_new(found: dict[str, Any]) -> None:
        make_all(found)
        kept.unlink()

    monkeypatch.setattr(tables, "make_all", make_new)
    tabulate(monkeypatch)
    assert kept.read_text() == "2"
    assert capsys.readouterr().out.startswith("new: reference/tables/B/b.csv\n2 tables")


def test_the_page_of_one_study_leaves_what_was_made_of_others(
    studies: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (studies / "reference/tables/A/report.csv").write_text("a page")
    made = studies / "results/tables"
    for name in ("A/old", "B/b.csv"):
        (made / name).parent.mkdir(parents=True)
        (made / name).touch()
    tabulate(monkeypatch, "--report", "A")
    assert capsys.readouterr().out == "results/tables/A/report.html\n"
    assert {str(path.relative_to(made)) for path in made.glob("*/*")} == {
        "A/report.html",
        "B/b.csv",
    }


def test_a_study_that_cannot_be_made_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def make(name: str, study: dict[str, Any]) -> None:
        (tmp_path / name).mkdir()
        (tmp_path / name / "snakemake.log").write_text(f"what {name} says\n")
        sys.exit(study["status"])

    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(tables, "MADE", tmp_path)
    monkeypatch.setattr(tables, "make", make)
    with pytest.raises(SystemExit) as ended:
        tables.make_all({"good": {"status": 0}, "bad": {"status": 1}})
    assert ended.value.code == "tables: bad: what bad says"
    tables.make_all({"better": {"status": 0}, "best": {"status": 0}})
    assert {path.name for path in tmp_path.iterdir()} == {"good", "bad", "better", "best"}
