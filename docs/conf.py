"""How Sphinx builds this folder: `make docs`. The pages are Markdown, to be read as they are, too."""

from __future__ import annotations

import importlib
import inspect
from typing import TYPE_CHECKING

import click
from docutils import nodes
from rsundistort_cli.main import cli
from sphinx.util.docutils import SphinxDirective

import rsundistort

if TYPE_CHECKING:
    from sphinx.application import Sphinx

project = "rsundistort"
author = "the authors of rsundistort"
version = release = rsundistort.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_click"]
exclude_patterns = ["_build"]

myst_heading_anchors = 3  # links to headings, as code hosts make them

for _name in cli.list_commands(click.Context(cli)):  # by which they are called; their functions are all `command`
    cli.get_command(click.Context(cli), _name).name = _name


def _show_defaults(command: click.Command) -> None:
    """Say it of each option: `cli` says it of all, in a setting that sphinx-click does not see."""
    for option in command.params:
        if isinstance(option, click.Option):
            option.show_default = not option.is_flag and option.to_info_dict()["default"] is not None
    for each in getattr(command, "commands", {}).values():
        _show_defaults(each)


for _name in cli.list_commands(click.Context(cli)):
    _show_defaults(cli.get_command(click.Context(cli), _name))

default_role = "literal"  # single backticks of docstrings

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings say types and shapes
autodoc_preserve_defaults = True
napoleon_google_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True  # attributes of dataclasses are fields of the class, not entries of their own

html_theme = "furo"
html_title = f"rsundistort {version}"
html_show_sphinx = False
html_show_copyright = False
html_copy_source = False


class PublicNames(SphinxDirective):
    """`public` MODULE KIND: what `__all__` of a module holds of a kind: functions, classes, options or errors."""

    required_arguments = 2

    def run(self) -> list[nodes.Node]:
        """The entries that autodoc makes."""
        name, kind = self.arguments
        module = importlib.import_module(name)
        blocks = []
        for each in module.__all__:
            if _kind(getattr(module, each)) == kind:
                directive = "autofunction" if kind == "functions" else "autoclass"
                members = "" if kind in ("functions", "errors") else "   :members:\n"
                blocks.append(f"```{{eval-rst}}\n.. {directive}:: {name}.{each}\n{members}```\n")
        return self.parse_text_to_nodes("\n".join(blocks))


def _kind(thing: object) -> str:
    if not inspect.isclass(thing):
        return "functions"
    if issubclass(thing, Exception):
        return "errors"
    return "options" if thing.__name__.endswith("Options") else "classes"


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.add_directive("public", PublicNames)
