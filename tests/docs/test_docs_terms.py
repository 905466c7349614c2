"""The words of the glossary are those of the viewer, the reports, the commands and OpenUSD: one name per thing."""

import ast
import re

import pytest
from doc_blocks import COMMANDS
from package_copy import ROOT

from jawusd.evaluator.verdicts import place
from jawusd.formats.poses import PARAMETER_COLUMNS

GLOSSARY = (ROOT / "docs" / "glossary.md").read_text()
SPEAKING = ("viewer", "report", "cli", "plugins/blender")  # parts of the package that people read
# What others call things that the glossary has a word for; none may be shown beside it.
SYNONYMS = {
    "laterotrusion": r"lateral(?: excursion| d2)?|lateral movement|sideways movement",
    "incisal point": r"incision point|incisor point|incisor moved|infradentale",
    "condyle": r"condylar head|jaw joint head",
    "margin": r"slack|headroom|distance to the bound",
    "tolerance": r"leeway|allowance",
    "clearance": r"interpenetration|penetration depth",
    "bound": r"\benvelope limit|boundary of the envelope",
    "protrusion": r"anterior displacement|propulsion",
}


def names_of_parameters():
    """Return the glossary's word for each of d1, d2, d3, lower case."""
    found = re.findall(r"^### (.+?) \{[^}]+\}\n+(?:Also: .*\n+)?Parameter `(d\d)`", GLOSSARY, flags=re.M)
    return {parameter: word.lower() for word, parameter in found}


def shown_texts():
    """Yield (file, text) of every string of the speaking parts that is no docstring, and of the report's pages."""
    for part in SPEAKING:
        folder = ROOT / "jawusd" / part
        for path in folder.rglob("*.py"):
            tree = ast.parse(path.read_text())
            expressions = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
            for node in ast.walk(tree):
                if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in expressions:
                    yield path.name, node.value
        for path in folder.rglob("*.j2"):
            yield path.name, path.read_text()
    for command in COMMANDS.values():
        yield command.name, " ".join([command.help or "", *(getattr(p, "help", None) or "" for p in command.params)])


def synonyms_in(text):
    """Return the words of others that a text uses, with the glossary's."""
    found = ((re.search(rf"\b(?:{pattern})\b", text, re.I), term) for term, pattern in SYNONYMS.items())
    return [(match[0], term) for match, term in found if match]


def misnamed(text, names):
    """Return the parameters that a text names beside another parameter's word, or beside none of the glossary's."""
    labels = re.findall(r"\b(d[123]) ([a-z]+)\b|\b([a-z]+) (d[123])\b", text)
    pairs = [(a or d, b or c) for a, b, c, d in labels]
    known = set(names.values()) | {"lateral", "sideways", "side", "gape", "protrude", "anterior", "forward"}
    return [(parameter, word) for parameter, word in pairs if word in known and word != names[parameter]]


def test_the_glossary_names_the_parameters():
    assert names_of_parameters() == dict(zip(PARAMETER_COLUMNS, ("opening", "laterotrusion", "protrusion")))
    missing = [term for term in SYNONYMS if not re.search(rf"^### {term} \{{", GLOSSARY, flags=re.M | re.I)]
    assert missing == []


def test_shown_texts_use_the_words_of_the_glossary():
    names, texts = names_of_parameters(), list(shown_texts())
    assert len(texts) > 1000
    assert [(file, *fault) for file, text in texts for fault in synonyms_in(text)] == []
    assert [(file, *fault) for file, text in texts for fault in misnamed(text, names)] == []
    labelled = {file for file, text in texts if all(word in text.lower() for word in ("d2", "laterotrusion"))}
    assert {"pose_panel.py", "plots.py", "figures.py", "solve_page.py"} <= labelled


@pytest.mark.parametrize("text", ["d2 lateral [mm]", "lateral d2 over opening d1", "d3 opening", "incisor moved"])
def test_another_word_is_found(text):
    assert synonyms_in(text) + misnamed(text, names_of_parameters())
    assert synonyms_in("d2 laterotrusion [mm]") + misnamed("d2 laterotrusion [mm]", names_of_parameters()) == []


def test_parameters_are_named_alike_in_usd_and_on_the_command_line():
    names = names_of_parameters()
    schema = (ROOT / "schemas" / "schema.usda").read_text()
    shown = dict(re.findall(r'double jaw:(d\d) = 0 \(\s*displayName = "(\w+)"', schema))
    assert {parameter: word.lower() for parameter, word in shown.items()} == names
    option = next(p for p in COMMANDS["pose"].params if "--d" in p.opts)
    places = [option.help.lower().index(names[parameter]) for parameter in sorted(names)]
    assert places == sorted(places)


def test_verdicts_are_worded_as_the_glossary_words_them():
    entry = re.search(r"^### Verdict \{.*?(?=^#)", GLOSSARY, flags=re.M | re.S)[0]
    for margin_mm in (0.5, -0.5, -2.0):
        assert re.match(r"[a-z ]+[a-z]", place(margin_mm, 1.0))[0] in entry
