"""The page of all commands, from the output of each with --help."""

import html

import typer

from jawusd.cli.commands import EXIT_CODES, GROUPS, SUMMARIES, help_row
from jawusd.cli.main import app

INTRODUCTION = """# Commands

This page is generated from the program and has the same text as `jawusd COMMAND --help`. `python -m jawusd` is the same
program. Results go to stdout and progress to stderr. `--json` prints machine-readable output. Nothing is overwritten
without `--force` (or `--resume` and `--fresh`, for commands that continue earlier work). Vectors are written
`--d 20 2 1` or `--d 20,2,1`. Options of `jawusd` itself come before the command:
`jawusd --log build.log build ...`.

"""


def page():
    """Return the page as Markdown."""
    program = typer.main.get_command(app)
    parts = [INTRODUCTION, "| group | command | what it does |\n|---|---|---|\n"]
    for group, names in GROUPS.items():
        heads = [group] + [""] * (len(names) - 1)
        parts += [
            f"| {head} | [`{name}`](#jawusd-{name}) | {escaped(names[name])} |\n"
            for head, name in zip(heads, names, strict=True)
        ]
    parts.append(f"\n{escaped(EXIT_CODES)} [Errors and exit codes](errors.md) lists them.\n\n")
    parts.append(section("jawusd", program, "jawusd"))
    parts += [section(f"jawusd {name}", program.commands[name], f"jawusd-{name}") for name in SUMMARIES]
    return "".join(parts)


def section(title, command, anchor):
    """Return the part of one command: usage, help, and every argument and option."""
    context = typer.Context(command, info_name=title, **command.context_settings)  # -h beside --help
    usage = " ".join(command.collect_usage_pieces(context))
    lines = [f"## {title} {{ #{anchor} }}\n\n```text\n{title} {usage}\n```\n\n"]
    if command.help:
        lines.append(escaped(command.help.replace("\f", "")) + "\n\n")
    for parameter in command.get_params(context):
        record = help_row(parameter, context)
        if record is not None:
            names, meaning = record
            lines.append(f"`{names}`\n:   {escaped(meaning) or 'See its name.'}\n\n")
    if title != "jawusd":
        lines.append(f"```sh\n{command.epilog}\n```\n\n")
    return "".join(lines)


def escaped(text):
    """Return text that Markdown shows as it is."""
    text = html.escape(text, quote=False)
    for sign in "\\`*_[]{}#|":
        text = text.replace(sign, "\\" + sign)
    return text
