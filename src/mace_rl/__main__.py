"""`python -m mace_rl`: the command `mace-rl`."""

from mace_rl.cli import main

if __name__ == "__main__":
    main()
