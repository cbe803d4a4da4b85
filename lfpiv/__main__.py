"""Run the command line with ``python -m lfpiv``."""

from lfpiv.cli.commands import main

if __name__ == "__main__":
    main()
