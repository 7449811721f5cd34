"""The command line. Commands import what they need when they run, so that ``isac-rt --help`` is
quick.

Exit 0: done; 2: the input or the machine will not do, in one message; 130: interrupted; 1: anything
else.
"""

from __future__ import annotations

import logging
import os
import sys
import traceback
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Annotated, Any

import typer
from rich.text import Text

import isac_rt
from isac_rt import registry
from isac_rt.cli import captures, setting_up, simulation, studies, sweeps
from isac_rt.cli.console import err
from isac_rt.cli.interruption import Terminated, say_interrupted
from isac_rt.runtime import UserError, of_machine, settle_process, shut_out_working_folder

DEBUG = "ISAC_RT_DEBUG"
PANELS: dict[str, dict[Callable[..., None], str]] = {
    "Run a scenario": {
        simulation.run: "run scenes/munich_swarm.yaml --out runs/munich "
        "--set noise.tx_power_dbm=20",
        simulation.demo: "demo --out first_look",
        simulation.plan: "plan scenes/munich_swarm.yaml --set accuracy.preset=everything",
        sweeps.sweep: "sweep scenes/sweeps/canyon_power.yaml --workers 2",
        sweeps.dataset: "dataset scenes/sweeps/canyon_dataset.yaml --workers 2",
    },
    "Look at a scenario or a run": {
        simulation.view: "view scenes/street_canyon.yaml",
        simulation.figures: "figures runs/munich --as svg --style column",
        simulation.animate: "animate runs/munich --out runs/munich/run.mp4",
        simulation.paths: "paths scenes/street_canyon.yaml --frame 3 --out paths.nc",
        simulation.export: "export runs/munich --as csv --out tables",
    },
    "Studies and checks": {
        studies.reproduce: "reproduce table1 fig8 --quick",
        studies.validate: "validate --quick --only geometry",
        studies.bench: "bench synthesis --quick",
    },
    "Radar boards": {
        captures.import_: "import adc_data.bin --description board.yaml --out cube.nc",
        captures.calibrate: "calibrate cube.nc --out board.cal --json",
        captures.receive: "receive cube.nc --calibration board.cal --out runs/measured",
    },
    "Set-up": {
        setting_up.new: "new mine.yaml --footprints buildings.geojson",
        setting_up.doctor: "doctor",
        setting_up.schema: "schema > scenario.schema.json",
    },
}
"""The commands by panel of ``--help``, each with an example of its use."""


def _untyped(params: Any) -> Any:
    """Return options whose help shows no type where they are flags, which take no value."""
    for param in params:
        param.metavar = "" if getattr(param, "is_flag", False) else param.metavar
    return params


class _Command(typer.core.TyperCommand):
    def get_params(self, ctx: Any) -> Any:
        return _untyped(super().get_params(ctx))


class _Commands(typer.core.TyperGroup):
    """The program's own commands, then those of other packages, which are imported when called."""

    def get_params(self, ctx: Any) -> Any:
        return _untyped(super().get_params(ctx))

    def list_commands(self, ctx: Any) -> list[str]:
        return [*super().list_commands(ctx), *sorted(registry.COMMANDS.installed())]

    def get_command(self, ctx: Any, name: str) -> Any:
        if name not in self.commands and name in registry.COMMANDS.installed():
            alone = typer.Typer(add_completion=False)
            alone.command(name, rich_help_panel="Other packages")(registry.COMMANDS.load(name))
            self.add_command(typer.main.get_command(alone), name)
        return super().get_command(ctx, name)


app = typer.Typer(
    cls=_Commands, add_completion=False, no_args_is_help=True, pretty_exceptions_enable=False
)
for _panel, _commands in PANELS.items():
    for _command, _example in _commands.items():
        _text = " ".join(str(_command.__doc__).split())
        app.command(
            _command.__name__.rstrip("_"),
            help=_text,
            short_help=_text.split(". ")[0].rstrip(".") + ".",
            epilog=f"Example: isac-rt {_example}",
            rich_help_panel=_panel,
            cls=_Command,
        )(_command)


def _print_versions(wanted: bool) -> None:
    if wanted:
        from isac_rt.storage import versions

        under = ", ".join(
            f"{name} {number}" for name, number in versions().items() if name != "isac_rt"
        )
        typer.echo(f"isac-rt {isac_rt.__version__} ({under})")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option(
            "--version",
            callback=_print_versions,
            is_eager=True,
            help="Print the versions and exit.",
        ),
    ] = False,
) -> None:
    """Simulate integrated sensing and communication of a UAV swarm in a ray-traced city."""


def _say_warning(message: Warning | str, category: type[Warning], *_: Any) -> None:
    if category.__module__.startswith("isac_rt"):
        err().print(Text.assemble(("warning", "yellow"), f" {message}"), soft_wrap=True)


def _settle_streams() -> None:
    """Give the process streams that take every text: what was closed before it began is as
    `/dev/null`, and letters that stdout cannot encode are replaced (stderr escapes them)."""
    while (opened := os.open(os.devnull, os.O_RDWR)) < 3:  # the lowest number that is free
        pass
    os.close(opened)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))
    stdout: Any = sys.stdout
    stdout.reconfigure(errors="replace")


def _flush_streams() -> None:
    """Write what is left; nobody may read it any more, which is no error."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            with suppress(OSError, ValueError):
                os.dup2(nowhere, stream.fileno())


def _complain(text: str) -> None:
    """Write a message to stderr, if that can be written."""
    with suppress(OSError, ValueError):
        sys.stderr.write(f"{text}\n")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status; of the process, if no arguments are given,
    which are then the process's own."""
    if arguments is not None:
        return _main(arguments)
    _settle_streams()
    status = _main(sys.argv[1:])
    _flush_streams()
    return status


def _main(arguments: Sequence[str]) -> int:
    settle_process()
    warnings.showwarning = _say_warning  # type: ignore[assignment]  # fewer arguments, by *_
    notes = logging.getLogger("isac_rt.inputs")  # what was read of logs and patterns
    notes.handlers = [logging.StreamHandler()]
    notes.setLevel(logging.INFO)
    try:
        shut_out_working_folder()
        status = app(
            args=captures.with_standard_output(list(arguments)),
            prog_name="isac-rt",
            standalone_mode=False,
        )
        if status == 130:  # what typer makes of Ctrl-C
            say_interrupted()
        return status if isinstance(status, int) else 0
    except KeyboardInterrupt:
        say_interrupted()
        return 130
    except Terminated as asked:
        say_interrupted()
        return 128 + asked.args[0]
    except Exception as problem:
        if os.environ.get(DEBUG):
            traceback.print_exc()
        if hasattr(problem, "exit_code"):  # typer's own: usage errors, exits and aborts
            text = problem.format_message() if hasattr(problem, "format_message") else ""
            if text:
                at = getattr(getattr(problem, "ctx", None), "command_path", "isac-rt")
                _complain(f"{text} (see {at} --help)")
            return int(problem.exit_code)
        if isinstance(problem, UserError):
            _complain(str(problem))
            return 2
        if of_machine(problem):
            message = str(problem) or "there is no more memory"
            _complain(f"{type(problem).__name__}: {message} (the machine's disk or memory)")
            return 2
        text = f"{type(problem).__name__}: {problem}"
        _complain(f"{text} (this is a fault of isac_rt; {DEBUG}=1 shows where)")
        return 1


if __name__ == "__main__":
    sys.exit(main())
