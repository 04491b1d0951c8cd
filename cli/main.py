"""Entry point: lists the commands without importing what they need."""

from __future__ import annotations

import importlib
from typing import Any

import click

from .stopping import stops_for_people
from .terminal import SOME_FAILED, forget_stdout, stdout_is_lost, warnings_for_people

# name: one line for the list of commands; the command itself is in the module of that name
_COMMANDS = {
    "run": "Rectify photos or a video, and find the camera poses.",
    "solve": "Do the same from a model of COLMAP or another program.",
    "readout": "Measure the readout time of a camera from a video.",
    "rectify": "Rectify a folder of photos with known motions.",
    "analyze": "Check whether camera poses are near a critical motion.",
    "simulate": "Make photos with a known shutter motion.",
    "evaluate": "Compare the outputs of a run with the truth.",
    "experiment": "Repeat the experiments of the paper on any scene.",
    "report": "Write the report of a run again, or figures for papers.",
    "info": "Show versions, threads and optional parts, or what a cameras.xml holds.",
    "completion": "Print the completion script of a shell.",
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


@click.command(cls=_LazyGroup, context_settings={"help_option_names": ["-h", "--help"], "show_default": True})
@click.version_option(package_name="rsundistort")
@click.pass_context
def cli(context: click.Context) -> None:
    """Remove rolling-shutter distortion from photos and videos, and find the camera poses.

    Start with: rsundistort run PHOTOS -o OUT
    """
    context.with_resource(warnings_for_people())
