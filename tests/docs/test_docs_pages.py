"""Every page can be read: a picture or an example on each, a picture in every guide, and short sentences."""

import re

import pytest
from doc_blocks import blocks, pages
from load_script import load_script
from package_copy import ROOT

LONGEST_WORDS = 40
PICTURE = re.compile(r"!\[([^\]]*)\]\([^)]+\.(?:webp|png|svg)\)|<video [^>]*src=|<!-- drawing: \w+ -->")
# Not part of a sentence: code, places of links, and the numbers of a list.
_APART = re.compile(r"`[^`]*`|\]\([^)]*\)|\]\[[^\]]*\]")
_BLOCK_START = re.compile(r"\s*(?:[-*] |\d+\. |#|\||<|!\[|$)")
_PAGES = pages()


def generated():
    """Return the text of the pages made from the code, without those that mkdocstrings fills with signatures."""
    pytest.importorskip("mkdocs", reason="jawusd[docs] is not installed")
    made = load_script(ROOT / "docs" / "hooks" / "generated_pages.py").pages()
    return {name: text for name, text in made.items() if not re.search(r"^::: ", text, flags=re.M)}


def shows_something(page, text):
    """Tell whether a page has a picture, or a block of code if it is no guide."""
    return bool(PICTURE.search(text)) or (not page.startswith("docs/guides/") and bool(blocks(page, text)))


def sentences(text):
    """Return the sentences of a page outside tables, headings and code, without what stands between backticks."""
    for block in blocks("", text):
        text = text.replace(block.text, "")
    text = re.sub(r"<!--.*?-->|```\w*", "", text, flags=re.S)
    paragraphs = [""]
    for line in text.splitlines():
        if _BLOCK_START.match(line):
            paragraphs.append("")
        if not line.lstrip().startswith(("|", "#", "<", "![")):
            paragraphs[-1] += " " + re.sub(r"^\s*(?:[-*>]|\d+\.) ", "", line).strip()
    plain = (_APART.sub(lambda found: "code" if found[0][0] == "`" else "", paragraph) for paragraph in paragraphs)
    return [part for paragraph in plain for part in re.split(r"(?<=[.!?:])\s+", paragraph) if part.strip()]


def hard_to_read(text):
    """Return the sentences with too many words, a seed, or the name of a commit."""
    wrong = re.compile(r"\bseeds?\b|\b(?=[0-9a-f]*\d)(?=[0-9a-f]*[a-f])[0-9a-f]{7,40}\b", flags=re.I)
    return [words for words in sentences(text) if len(words.split()) > LONGEST_WORDS or wrong.search(words)]


def test_every_page_has_a_picture_or_an_example_and_every_guide_a_picture():
    texts = {page: (ROOT / page).read_text() for page in _PAGES} | generated()
    assert len(texts) > 35
    assert [page for page, text in texts.items() if not shows_something(page, text)] == []


def table_figures(text):
    """Return the decimal fractions in the tables of a page."""
    rows = "\n".join(line for line in text.splitlines() if line.startswith("|"))
    return set(re.findall(r"(?<![\d.])\d+\.\d+(?![\d.])", rows))


def test_figures_of_the_readme_stand_in_tables_of_the_documentation():
    readme = table_figures((ROOT / "README.md").read_text())
    listed = [table_figures((ROOT / page).read_text()) for page in _PAGES if page.startswith("docs/")]
    assert len(readme) > 20 and readme - set().union(*listed) == set()
    assert table_figures("0.5\n| a | 0.25 / 1.5 |\n") == {"0.25", "1.5"}


@pytest.mark.parametrize(
    ("page", "text"),
    [
        ("docs/start/film.md", "# Film\n\nWords.\n\n| a | b |\n|---|---|\n| `c` | d |\n"),
        ("docs/guides/web.md", "# The web\n\n```sh\njawusd info out\n```\n"),
    ],
)
def test_a_page_without_is_found(page, text):
    assert not shows_something(page, text)
    assert shows_something(page, text + "\n![A rig on a phone](../gallery/phone.webp)\n")


def test_pictures_say_in_words_what_they_show():
    said = [words for page in _PAGES for words in PICTURE.findall((ROOT / page).read_text()) if words]
    assert len(said) > 20
    assert [words for words in said if len(words.split()) < 3] == []


def test_sentences_are_short_and_name_neither_seeds_nor_commits():
    found = {page: hard_to_read((ROOT / page).read_text()) for page in _PAGES}
    assert len([words for page in _PAGES for words in sentences((ROOT / page).read_text())]) > 500
    assert {page: wrong for page, wrong in found.items() if wrong} == {}


@pytest.mark.parametrize(
    "text",
    ["word " * 41 + "end.", "Ten more (seed 8100).", "Measured at 79f4612 on two cores.", "- " + "a " * 50],
)
def test_a_sentence_that_is_hard_to_read_is_found(text):
    assert hard_to_read("# Title\n\nShort words.\n\n" + text)
    assert not hard_to_read("| " + text + " |\n\n```text\n" + text + "\n```\n")
