"""The command `mace-rl`, also as `python -m mace_rl`."""

import sys


def main() -> None:
    """Entry point; exits with 130, quietly, if it is interrupted while modules are imported."""
    try:
        from mace_rl.cli import main as command
    except KeyboardInterrupt:
        sys.exit(130)
    command()


if __name__ == "__main__":
    main()
