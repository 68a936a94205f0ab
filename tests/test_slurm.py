"""Slurm: its profile, what is asked of its queue, and the test that starts a cluster of its own.

The cluster itself is tested by `make slurm-test`.
"""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest
import yaml
from snakemake.cli import parse_args

from mace_rl.runs import queueing
from tools import slurm_test

ROOT = Path(__file__).parents[1]
PROFILE = ROOT / "profiles" / "slurm" / "config.yaml"
NODE = "NodeName=moon CPUs=2 RealMemory=4000\nUpTime=0-00:00:01\n"


def test_snakemake_knows_every_key_of_the_profile() -> None:
    _, arguments = parse_args(["--workflow-profile", str(PROFILE), "all"])
    assert arguments.executor == "slurm" and arguments.logger == ["mace-rl"]
    assert arguments.retries == 3 and arguments.cores == 1 and arguments.slurm_requeue
    sizes = arguments.group_components
    assert sizes == {f"runs_{size}": size for size in sizes.values()}


def test_a_key_that_snakemake_does_not_know_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text(PROFILE.read_text() + "slurm-requeues: true\n")
    with pytest.raises(SystemExit):
        parse_args(["--workflow-profile", str(tmp_path / "config.yaml"), "all"])


def test_the_profile_has_all_of_the_default_one() -> None:
    default = yaml.safe_load((ROOT / "profiles" / "default" / "config.yaml").read_text())
    slurm = yaml.safe_load(PROFILE.read_text())
    # What is computed is of one machine: as many jobs as it has cores.
    wanted = {key: value for key, value in default.items() if not key.startswith(("__", "?"))}
    assert "rerun-triggers" in wanted
    assert {key: slurm.get(key) for key in wanted} == wanted


def test_only_trainings_go_into_the_queue() -> None:
    files = [ROOT / "Snakefile", *(ROOT / "workflow" / "rules").iterdir()]
    text = "".join(file.read_text() for file in files)
    local = re.findall(r"^ *localrules:\n((?: +[\w, ]+\n)+)", text, re.MULTILINE)
    rules = set(re.findall(r"^ *(?:use )?rule (?:\w+ as )?(\w+)\b", text, re.MULTILINE))
    assert "forest" in rules, "which is there for some studies only"
    assert rules - set(re.findall(r"\w+", " ".join(local))) == {"train"}


def test_minutes_grow_with_the_work(run_config) -> None:
    compiled, other = run_config("CartPole-v1"), run_config("HopperBulletEnv-v0")
    assert queueing.minutes(compiled, 0.0) == 2
    assert queueing.minutes(compiled, 30_000 * 60 * 5) == 7
    assert queueing.minutes(other, 3_000 * 60 * 5) == 7
    assert queueing.minutes(run_config("CartPole-v1", engine="torch"), 300 * 60 * 5) == 7


@pytest.mark.parametrize(
    ("minutes", "expected"), [(1, "b"), (12, "b"), (13, "a"), (60, "a"), (61, None), (9999, None)]
)
def test_an_entry_holds_as_many_runs_as_two_hours_do(minutes: int, expected: str | None) -> None:
    assert queueing.entry(minutes, {"a": 2, "b": 10}) == expected
    assert queueing.entry(minutes, {}) is None


@pytest.mark.slow
def test_a_thousand_short_runs_are_some_dozen_entries() -> None:
    command = [sys.executable, "-m", "snakemake", "-n", "all", "--workflow-profile", str(PROFILE)]
    command += ["--config", "environments=[CartPole-v1]", f"seeds={[*range(334)]}".replace(" ", "")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    runs = re.findall(r"^ +rule train:$", done.stdout + done.stderr, re.MULTILINE)
    entries = re.findall(r"Group job runs_(\d+) ", done.stdout + done.stderr)
    # 334 runs of PPO, 40 to an entry, and 668 with a bonus, 20 to an entry.
    assert len(runs) == 1002
    assert sorted(entries) == ["20"] * 34 + ["40"] * 9


def refusal(*, search: str, **environment: str) -> str:
    """What `make slurm-test` says where it cannot work, and that it is one line."""
    done = subprocess.run(
        [sys.executable, "-m", "tools.slurm_test"],
        cwd=ROOT,
        env=os.environ | {"PATH": search} | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1 and done.stdout == ""
    [line] = done.stderr.splitlines()
    return line


@pytest.fixture
def programs(tmp_path: Path) -> Path:
    """A folder with stand-ins for Slurm's programs: daemons that start, a cluster that does not."""
    folder = tmp_path / "programs"
    folder.mkdir()
    for name in slurm_test.PROGRAMS:
        (folder / name).write_text("#!/bin/sh\nexec sleep 100\n")
    (folder / "slurmd").write_text(
        f"#!/bin/sh\n[ $1 != -C ] || {{ printf '{NODE}'; exit; }}\nexec sleep 100\n"
    )
    (folder / "munged").write_text(
        "#!/bin/sh\nfor i; do case $i in --socket=*) touch ${i#*=};; esac; done\nexec sleep 100\n"
    )
    for name in ("sinfo", "scancel"):
        (folder / name).write_text("#!/bin/sh\nexit 1\n")
    for program in folder.iterdir():
        program.chmod(0o755)
    return folder


@pytest.mark.slow
def test_what_is_missing_is_said_in_one_line(tmp_path: Path, programs: Path) -> None:
    line = refusal(search=str(tmp_path))
    assert line.startswith("slurm test: munged, slurmctld, slurmd, ")
    assert line.endswith("are missing; Debian and Ubuntu: apt-get install slurm-wlm munge")
    (programs / "munged").unlink()
    assert refusal(search=str(programs)).startswith("slurm test: munged is missing; ")


@pytest.mark.slow
def test_a_cluster_of_somebody_elses_is_refused(programs: Path) -> None:
    line = refusal(search=str(programs), SLURM_CONF="/etc/their.conf")
    assert "already, /etc/their.conf; not touched" in line


@pytest.mark.parametrize(
    ("content", "advice"),
    [("ClusterName=theirs\n", "not touched"), (f"{slurm_test.SIGN}\n", "remove the file")],
)
def test_a_configuration_is_refused_and_left_alone(
    tmp_path: Path, programs: Path, monkeypatch: pytest.MonkeyPatch, content: str, advice: str
) -> None:
    found = tmp_path / "slurm.conf"
    found.write_text(content)
    monkeypatch.setattr(slurm_test, "CONFIGURATION", found)
    monkeypatch.setenv("PATH", str(programs))
    monkeypatch.delenv("SLURM_CONF", raising=False)
    with pytest.raises(slurm_test.Unfit, match=f"already, {found}; .*{advice}"):
        slurm_test.require()
    assert found.read_text() == content


def test_nothing_is_left_of_a_cluster_that_does_not_come_up(
    tmp_path: Path, programs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "etc" / "slurm" / "slurm.conf"
    place.parent.parent.mkdir()
    monkeypatch.setattr(slurm_test, "CONFIGURATION", place)
    monkeypatch.setenv("PATH", f"{programs}:{os.environ['PATH']}")
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(subprocess.CalledProcessError), slurm_test.cluster(scratch):
        raise AssertionError("it came up")
    assert not place.parent.exists()
    assert signal.getsignal(signal.SIGTERM) == before
    children = psutil.Process().children(recursive=True)
    assert [child for child in children if child.name() == "sleep"] == []


def test_the_cluster_is_this_machine(
    tmp_path: Path, programs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", f"{programs}:{os.environ['PATH']}")
    text = slurm_test.configuration(tmp_path)
    lines = text.splitlines()
    assert "NodeName=moon CPUs=2 RealMemory=4000 NodeAddr=127.0.0.1" in lines
    assert "SlurmctldHost=moon(127.0.0.1)" in lines
    paths = set(re.findall(r"=(/[^,\s]+)", text)) - {"/bin/true"}
    assert len(paths) == 5 and all(Path(path).parent == tmp_path for path in paths)
