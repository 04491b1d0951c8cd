"""`rsundistort completion`."""

from __future__ import annotations

import click
from click.shell_completion import get_completion_class

from .terminal import tell


@click.command()
@click.argument("shell", type=click.Choice(("bash", "zsh", "fish")))
def command(shell: str) -> None:
    """Print the script that lets a shell complete commands and options.

    For bash, put eval "$(rsundistort completion bash)" into ~/.bashrc; for zsh, the same with zsh into ~/.zshrc. For
    fish, run rsundistort completion fish > ~/.config/fish/completions/rsundistort.fish
    """
    from .main import cli

    kind = get_completion_class(shell)
    assert kind is not None
    tell(kind(cli, {}, "rsundistort", "_RSUNDISTORT_COMPLETE").source())
