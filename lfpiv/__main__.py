"""Start the command line: ``lfpiv``, or ``python -m lfpiv``."""

from lfpiv.cli import interrupts


def main() -> None:
    """Run the command line. Signals are answered before its imports begin."""
    interrupts.watch()
    from lfpiv.cli.commands import main

    main()


if __name__ == "__main__":
    main()
