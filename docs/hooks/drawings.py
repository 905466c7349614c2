"""Put the drawings of the project into its pages: a line `<!-- drawing: NAME -->` becomes the SVG."""

import re
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from figures import FIGURES

MARK = re.compile(r"^<!-- drawing: (\w+) -->$", re.M)


def on_page_markdown(markdown, **kwargs):
    """Replace every mark by its drawing."""
    return MARK.sub(lambda found: f'<div class="drawing-frame">{FIGURES[found[1]]()}</div>', markdown)
