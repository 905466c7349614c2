"""Draw the tables of a page: a line `<!-- chart: WORDS | OPTION ... -->` after a table becomes an SVG of its numbers.

WORDS name the axis with its unit. Options: `log`, a logarithmic axis; `rows 1-3` and `columns 2-3`, those that are
drawn; `labels 4`, the number of columns that name a row.
"""

import html
import math
import re
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from figures import circle, path, svg, text

MARK = re.compile(r"^<!-- chart: (.+) -->$", re.M)
NUMBER = re.compile(r"(?<![\w.])-?\d{1,3}(?:,\d{3})+(?![\d])|(?<![\w.])-?\d+(?:\.\d+)?(?:e-?\d+)?")
SHARE = re.compile(r"^([\d,]+) of ([\d,]+)$")
WIDTH, LEFT, RIGHT, TOP, ROW, MOST_LETTERS = 680, 14, 640, 34, 40, 96
FILLS = ("fill1", "fill2", "fill3")


def cells(line):
    """Return the cells of a line of a table."""
    return [cell.strip() for cell in line.strip().strip("|").split("|")]


def table_before(markdown, end):
    """Return the head and the rows of the table that ends before a place in a page."""
    lines = markdown[:end].rstrip().split("\n")
    first = len(lines)
    while first and lines[first - 1].startswith("|"):
        first -= 1
    rows = [cells(line) for line in lines[first:]]
    if len(rows) < 3:
        raise ValueError(f"there is no table before the chart: {markdown[end : end + 60]}")
    return rows[0], rows[2:]


def numbers(cell):
    """Return the numbers in a cell; "3 of 4" is a percentage."""
    share = SHARE.match(cell)
    if share:
        part, whole = (float(number.replace(",", "")) for number in share.groups())
        return [100.0 * part / whole]
    return [float(number.replace(",", "")) for number in NUMBER.findall(cell)]


def plain(words):
    """Return text without the marks of Markdown."""
    return re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", words).replace("`", "").strip()


def options_of(mark):
    """Return the words of a chart, whether it is logarithmic, and the values of `rows`, `columns` and `labels`."""
    words, *given = (part.strip() for part in mark.split("|"))
    spans = {"rows": None, "columns": None, "labels": (1, 1)}
    for option in given:
        name, *span = option.split()
        if name != "log" and (name not in spans or len(span) != 1):
            raise ValueError(f'a chart has no option "{option}"')
        if span:
            ends = [int(end) for end in span[0].split("-")]
            spans[name] = ends[0], ends[-1]
    return words, "log" in given, spans


def chosen(markdown, found):
    """Return the words, the scale, the series and the rows of a chart: label and numbers of every series."""
    words, log, spans = options_of(found[1])
    head, body = table_before(markdown, found.start())
    named = spans["labels"][1]
    first, last = spans["columns"] or (named + 1, len(head))
    top, bottom = spans["rows"] or (1, len(body))
    rows = []
    for row in body[top - 1 : bottom]:
        label = plain(row[0]) if named == 1 else ", ".join(f"{a} {b}" for a, b in zip(head[:named], row))
        values = [numbers(cell) for cell in row[first - 1 : last]]
        if any(values):
            rows.append((label, values))
    return words, log, [plain(name) for name in head[first - 1 : last]], rows


def scale_of(values, log):
    """Return the function from numbers to shares of the axis, and the ticks; an axis without `log` starts at zero."""
    high = max(values)
    if log:
        positive = [value for value in values if value > 0]
        low = math.floor(math.log10(min(positive)))
        top = max(math.ceil(math.log10(high)), low + 1)
        return (lambda x: (math.log10(max(x, 10.0**low)) - low) / (top - low)), [10.0**k for k in range(low, top + 1)]
    power = 10.0 ** math.floor(math.log10(high or 1.0))
    step = next(step for step in (0.2 * power, 0.5 * power, power, 2 * power) if high / step <= 6)
    count = max(math.ceil(high / step - 1e-9), 1)
    return (lambda x: x / (step * count)), [step * k for k in range(count + 1)]


def chart(markdown, found):
    """Return the SVG of a chart: a line of dots for each row; later numbers of a cell are rings."""
    words, log, names, rows = chosen(markdown, found)
    at, ticks = scale_of([x for _, values in rows for cell in values for x in cell], log)
    place = lambda x: LEFT + at(x) * (RIGHT - LEFT)  # noqa: E731
    height = TOP + ROW * len(rows) + 44
    parts, across = [], LEFT
    if any(names) and len(names) > 1:
        for name, fill in zip(names, FILLS):
            parts += [circle(across + 5, 12, 5, fill), text(across + 16, 17, html.escape(name), "start", "small")]
            across += 34 + 7 * len(name)
    for tick in ticks:
        x, bottom = place(tick), TOP + ROW * len(rows)
        parts += [path([(x, TOP - 8), (x, bottom)], "thin"), text(x, bottom + 16, f"{tick:g}", kind="small")]
    parts.append(text((LEFT + RIGHT) / 2, height - 6, html.escape(words), kind="small"))
    for k, (label, values) in enumerate(rows):
        y = TOP + ROW * k + 26
        short = label if len(label) <= MOST_LETTERS else f"{label[: MOST_LETTERS - 2].rsplit(' ', 1)[0]} ..."
        parts.append(text(LEFT, y - 12, html.escape(short), "start", "small"))
        spread = [place(x) for cell in values for x in cell]
        parts.append(path([(min(spread), y), (max(spread), y)]))
        for cell, fill in zip(values, FILLS):
            for place_of, x in enumerate(cell):
                ring = f"{fill} ring" if place_of else fill
                dot = circle(place(x), y, 5, ring).replace("/>", f"><title>{x:g}</title></circle>")
                parts.append(dot)
    return svg(WIDTH, height, html.escape(f"Chart of the table above: {words}"), parts)


def on_page_markdown(markdown, **kwargs):
    """Replace every mark by its chart."""
    return MARK.sub(lambda found: f'<div class="drawing-frame">{chart(markdown, found)}</div>', markdown)
