"""Link the first use of every term of the glossary, on every page, to its entry in the glossary."""

import re

from mkdocs.utils import get_relative_url

_terms = {}  # anchor by term, lower case
_TAGS = re.compile(r"(<[^>]+>)")
_CLOSED = ("a", "code", "pre", "h1", "h2", "h3", "h4", "h5", "svg", "script", "style", "button", "label")


def terms_of(text):
    """Return the anchors of a glossary by term: `## Term { #anchor }`, other spellings after "also:"."""
    found = {}
    for heading, anchor, body in re.findall(r"^### (.+?) \{ #([\w-]+) \}\n+(.*?)(?=^#|\Z)", text, flags=re.M | re.S):
        also = re.search(r"^Also: (.+)\.$", body, flags=re.M)
        for term in [heading, *(also[1].split(", ") if also else [])]:
            found[term.lower()] = anchor
    return found


def on_files(files, config):
    """Read the terms before any page is made."""
    _terms.clear()
    _terms.update(terms_of(files.get_file_from_path("glossary.md").content_string))
    return files


def on_page_content(html, page, **kwargs):
    """Link the terms of a page."""
    if page.file.src_uri == "glossary.md":
        return html
    return linked(html, _terms, get_relative_url("glossary.html", page.url))


def linked(html, terms, glossary):
    """Return HTML with the first use of every term linked to the page of the glossary."""
    if not terms:
        return html
    left = dict(terms)
    words = "|".join(sorted(map(re.escape, terms), key=len, reverse=True))
    # Neither in names, as jaw:model:kind, nor in terms of others.
    pattern = re.compile(rf"(?<!Cramer-Rao )(?<![\w:/.])({words})(?![\w/]|[:.]\w)", re.I)
    closed, out = 0, []

    def link(found):
        anchor = left.get(found[0].lower())
        if anchor is None:
            return found[0]
        for term in [term for term, place in left.items() if place == anchor]:
            del left[term]
        return f'<a class="term" href="{glossary}#{anchor}">{found[0]}</a>'

    for part in _TAGS.split(html):
        if part.startswith("<"):
            name = re.match(r"</?(\w+)", part)
            if name and name[1] in _CLOSED:
                closed += -1 if part.startswith("</") else 1
            out.append(part)
        else:
            out.append(part if closed else pattern.sub(link, part))
    return "".join(out)
