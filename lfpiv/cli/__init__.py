"""Command line `lfpiv`: commands, their output on the terminal, the demonstration, and the self-test."""
