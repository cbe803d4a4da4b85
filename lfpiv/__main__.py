"""``python -m lfpiv``: the command line."""

from lfpiv.cli.commands import main

if __name__ == "__main__":
    main()
