"""The program `lfpiv`: its options, the options that commands share, and how a command is registered."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from lfpiv.cli import interrupts
from lfpiv.cli.terminal import OUTPUT
from lfpiv.version import __version__

app = typer.Typer(
    name="lfpiv",
    help="Multi-camera light-field PIV: raw plenoptic camera images in, 3D velocity volumes out.",
    invoke_without_command=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _show_version(value: bool) -> None:
    if value:
        print(f"lfpiv {__version__}")
        raise typer.Exit


ExperimentFile = Annotated[Path, typer.Argument(metavar="EXPERIMENT.toml", help="The experiment file.")]
Out = Annotated[Path, typer.Option("--out", "-o", metavar="DIR", help="Folder for everything the run writes.")]
Pairs = Annotated[
    str,
    typer.Option(
        "--pairs",
        metavar="A:B",
        help="Pairs, or instants of a series, A to B - 1 only; either may be left out. One number is a single pair.",
    ),
]
Device = Annotated[
    Literal["auto", "cpu", "cuda"] | None,
    typer.Option("--device", help="Where kernels run; default: compute.device of the experiment file."),
]
Workers = Annotated[
    int | None,
    typer.Option("--workers", metavar="W", help="Processes that work side by side; default: 1, one per GPU."),
]
Debug = Annotated[bool, typer.Option("--debug", help="Show debug messages and tracebacks.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Show warnings and errors only.")]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]


@app.callback()
def _options(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version.")
    ] = False,
    debug: Debug = False,
) -> None:
    OUTPUT.debug = debug
    if context.invoked_subcommand is None:
        print(context.get_help())


def command(
    name: str, *examples: str, group: typer.Typer = app
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Register a command with examples in its help, and with the options of `OUTPUT` after its own."""

    def register(function: Callable[..., None]) -> Callable[..., None]:
        def called(quiet: Quiet = False, as_json: Json = False, debug: Debug = False, **options: Any) -> None:
            OUTPUT.quiet, OUTPUT.json, OUTPUT.debug = quiet, as_json, OUTPUT.debug or debug
            try:
                function(**options)
            except KeyboardInterrupt as error:
                raise interrupts.Interrupted from error

        own, common = (inspect.signature(one, eval_str=True) for one in (function, called))
        parameters = [*own.parameters.values(), *list(common.parameters.values())[:-1]]
        by_name = [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in parameters]
        called.__signature__ = own.replace(parameters=by_name)  # type: ignore[attr-defined]
        called.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
        called.__doc__ = function.__doc__
        epilog = "\b\nExamples:\n" + "\n".join(f"  {example}" for example in examples)  # \b keeps the line breaks
        group.command(name, epilog=epilog)(called)
        return function

    return register
