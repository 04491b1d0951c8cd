"""Entry point: lists the commands without importing what they need."""

from __future__ import annotations

import importlib
from typing import Any

import click

from .stopping import stops_for_people
from .terminal import SOME_FAILED, forget_stdout, stdout_is_lost, warnings_for_people

# name: one line for the list of commands; the command itself is in the module of that name
_COMMANDS = {
    "run": "Photos in, rectified photos and camera poses out.",
    "solve": "A COLMAP model in, the same without the shutter out.",
    "readout": "How long a camera takes to read a frame, from a video.",
    "rectify": "Rectify a folder of photos with a solution.",
    "analyze": "Whether poses let the shutter be told from the scene's shape.",
    "simulate": "Photos with a known shutter motion.",
    "evaluate": "Errors of a run against the truth.",
    "experiment": "The paper's experiments, on any scene.",
    "report": "The report of a run again, or its figures for papers.",
    "info": "Versions, threads and optional parts.",
    "completion": "What makes a shell complete commands and options.",
}


class _LazyGroup(click.Group):
    """Imports a command's module when it is asked for: `--help` stays quick."""

    def make_context(self, *args: Any, **named: Any) -> click.Context:
        with stops_for_people():
            return super().make_context(*args, **named)

    def invoke(self, ctx: click.Context) -> Any:
        forget_stdout()
        with stops_for_people():
            value = super().invoke(ctx)
        if stdout_is_lost():
            ctx.exit(SOME_FAILED)
        return value

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(_COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in _COMMANDS:
            return None
        command: click.Command = importlib.import_module(f"rsundistort_cli.{cmd_name}").command
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl(list(_COMMANDS.items()))


@click.command(cls=_LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="rsundistort")
@click.pass_context
def cli(context: click.Context) -> None:
    """Take the rolling shutter out of photos, and find where they were taken from.

    Start with: rsundistort run PHOTOS -o OUT
    """
    context.with_resource(warnings_for_people())
