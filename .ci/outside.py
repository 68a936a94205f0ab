"""What `make test-wheel` does in each environment: python outside.py PROJECT NAME.

Only what somebody has who installed the wheel, in an empty folder: of PROJECT no file is used but
its pages, whose examples are carried out, and the plugins in extras/.
"""

import importlib.util
import io
import json
import re
import shlex
import shutil
import subprocess
import sys
from contextlib import redirect_stdout
from importlib.metadata import version
from pathlib import Path

# Where the pages' trainings are longer than it takes to see that they work.
SHORT = {"learn(10_000)": "learn(300)", "episodes=200": "episodes=4"}
STUDY = ("snakemake", "pybullet", "pandas", "matplotlib", "seaborn")
PYTHON = shlex.quote(sys.executable)
OPTIONS = "--env CartPole-v1 --variant mace_full --episodes 9"
RUN = "runs/CartPole-v1/mace_full/seed0"
COMMANDS = [
    f"{PYTHON.removesuffix(Path(sys.executable).name)}mace-rl train {OPTIONS}",
    f"{PYTHON} -m mace_rl train {OPTIONS} --env Blackjack-v1 --max-episode-steps 20",
    f"{PYTHON} -m mace_rl evaluate {RUN} --episodes 2",
    f"{PYTHON} -m mace_rl export runs --out runs.csv",
]
PARQUET = f"{PYTHON} -m mace_rl export runs --out runs.parquet"


def shell(command: str) -> None:
    """Carry out a command; what it says is shown if it fails."""
    done = subprocess.run(shlex.split(command), stdout=-1, stderr=subprocess.STDOUT, text=True)
    if done.returncode:
        sys.exit(f"{command}: exit code {done.returncode}\n{done.stdout}")


def blocks(page: Path, language: str) -> list[str]:
    """The examples on a page."""
    text = page.read_text(encoding="utf-8")
    for long, short in SHORT.items():
        text = text.replace(long, short)
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def main() -> None:
    """Everything, one after the other; exits with 1 at the first that fails."""
    project = Path(sys.argv[1])
    for name in STUDY if sys.argv[2] != "debian13" else ():  # whose torch brings some of them
        assert importlib.util.find_spec(name) is None, f"{name} is not of the core"
    for command in COMMANDS:
        shell(command)
    if importlib.util.find_spec("pyarrow"):
        shell(PARQUET)
    versions = json.loads(Path(RUN, "run.json").read_text(encoding="utf-8"))["versions"]
    assert all(version(name) == found for name, found in list(versions.items())[1:]), versions
    assert "pybullet" not in versions
    for page in ("README.md", "docs/wrappers.md"):
        names: dict[str, object] = {}
        for block in blocks(project / page, "python"):
            with redirect_stdout(io.StringIO()):
                exec(block, names)
    extending = project / "docs" / "extending.md"
    for block in blocks(extending, "python") + blocks(extending, "yaml"):
        name = block.splitlines()[0].removeprefix("# ")
        Path(name).write_text(block, encoding="utf-8")
    shutil.copytree(project / "extras", "extras")  # which the wheel does not have: the page says so
    for block in blocks(extending, "sh"):
        for command in re.findall(r"^mace-rl (train .*)$", block, re.MULTILINE):
            shell(f"{PYTHON} -m mace_rl {command}")
    others = {name: version(name) for name in ("stable-baselines3", "gymnasium", "torch", "numpy")}
    print(
        sys.argv[2] + ":",
        " ".join(f"{name} {found}" for name, found in (versions | others).items()),
    )


if __name__ == "__main__":
    main()
