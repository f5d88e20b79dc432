"""Docstrings as help for terminals of any width: their lines are as long as the source's, which breaks oddly there."""

from __future__ import annotations

import inspect
import re

from cyclopts import App


def reflow_help(app: App, *shared: type) -> None:
    """Let every command of `app`, and the classes of options that commands share, have paragraphs of one line each."""
    for name in app:
        command = app[name]
        function = command.default_command
        if inspect.isfunction(function) and function.__doc__:
            function.__doc__ = reflowed(function.__doc__)
        if not name.startswith("-"):
            reflow_help(command)
    for options in shared:
        options.__doc__ = reflowed(options.__doc__ or "")


def reflowed(docstring: str) -> str:
    """Lines of one paragraph joined; examples, indented by two, and headings with their underlines stay."""
    lines: list[str] = []
    for line in inspect.cleandoc(docstring).splitlines():
        indent, before = _indent(line), lines[-1] if lines else ""
        paragraph = indent in (0, 4) and line.strip() and before.strip() and indent == _indent(before)
        if paragraph and not re.fullmatch("-+", line) and not re.fullmatch("-+", before):
            lines[-1] = f"{before} {line.strip()}"
        else:
            lines.append(line)
    return "\n".join(lines)


def _indent(line: str) -> int:
    return len(line) - len(line.lstrip())
