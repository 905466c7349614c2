"""Read the code blocks of README and documentation, and tell whether a command line or an output is what they say."""

import re
import shlex
from dataclasses import dataclass

import typer
import yaml
from package_copy import ROOT

from jawusd.cli.main import app

COMMANDS = typer.main.get_command(app).commands
ELLIPSIS = "…"
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?")
_BLOCK = re.compile(r"^([ ]*)```([\w-]*)\n(.*?)^\1```", re.M | re.S)
_PARSED = re.compile(r"<!-- parsed: .+ -->\s*$")


@dataclass(frozen=True)
class Block:
    """One block of code of a page."""

    page: str  # relative to the repository
    line: int
    language: str
    text: str
    parsed: bool  # marked as not to be run: it needs a program or device that tests do not have

    def __str__(self):
        return f"{self.page}:{self.line}"


class _Config(yaml.SafeLoader):
    """YAML of mkdocs, whose tags do not matter here."""


_Config.add_multi_constructor("!", lambda loader, suffix, node: None)


def pages():
    """Return the README and every page of the documentation that people write, in the order of the navigation."""
    config = yaml.load((ROOT / "mkdocs.yml").read_text(), _Config)
    listed = [name for name in places(config["nav"]) if (ROOT / "docs" / name).exists()]
    return ["README.md", *(f"docs/{name}" for name in listed)]


def places(entry):
    """Yield the pages of a part of the navigation."""
    if isinstance(entry, str):
        yield entry
    for inner in entry.values() if isinstance(entry, dict) else entry if isinstance(entry, list) else ():
        yield from places(inner)


def blocks(page, text=None):
    """Return the blocks of a page."""
    text = (ROOT / page).read_text() if text is None else text
    found = []
    for match in _BLOCK.finditer(text):
        indent = len(match[1])
        body = "".join(line[indent:] for line in match[3].splitlines(keepends=True))
        before = text[: match.start()]
        found.append(Block(page, before.count("\n") + 1, match[2], body, bool(_PARSED.search(before))))
    return found


def command_lines(text):
    """Return every command line of jawusd in blocks of shell and between backticks, without comments."""
    shell = "\n".join(b.text for b in blocks("", text) if b.language in ("sh", "console")).replace("\\\n", " ")
    quoted = re.findall(r"`(jawusd [^`]+)`", " ".join(text.split()))
    return [line for line in [*shell.splitlines(), *quoted] if re.search(r"(^|[ /])jawusd (-|[a-z])", line)]


def unknown(line):
    """Return what a command line uses that the program does not know, None if all is known."""
    for part in re.split(r"&&|;", line.split("  #")[0].removeprefix("$ ")):
        words = shlex.split(part)
        at = [k for k, word in enumerate(words) if word.split("/")[-1] == "jawusd"]
        if not at or words[at[0] + 1].startswith("-") or words[at[0] + 1] == "COMMAND":
            continue
        name, *rest = words[at[0] + 1 :]
        if name not in COMMANDS:
            return f"{line}: no command {name}"
        known = {option for parameter in COMMANDS[name].params for option in parameter.opts + parameter.secondary_opts}
        for word in rest:
            if re.match(r"--?[a-z]", word) and word.split("=")[0] not in known | {"--help"}:
                return f"{line}: no option {word}"
    return None


def steps(block):
    """Return a console block as (command, lines expected)."""
    found = []
    for line in block.text.splitlines():
        if line.startswith("$ "):
            found.append((line[2:], []))
        else:
            found[-1][1].append(line)
    return found


def alike(expected, printed):
    """Tell whether two lines have the same words, and numbers that differ by no more than machines do."""
    if NUMBER.sub("#", expected).split() != NUMBER.sub("#", printed).split():
        return False
    pairs = zip(NUMBER.findall(expected), NUMBER.findall(printed), strict=True)
    return all(abs(float(a) - float(b)) <= 0.3 + 0.05 * abs(float(a)) for a, b in pairs)


def missing(expected, printed):
    """Return the first line expected that does not come in its order, None if all do."""
    rest = iter(printed)
    return next((line for line in expected if line != ELLIPSIS and not any(alike(line, p) for p in rest)), None)
