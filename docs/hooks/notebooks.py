"""Show every notebook of docs/notebooks as a page, with what it printed and drew when it was stored.

A notebook is JSON: cells of Markdown are taken as they are, cells of code become blocks with their output below.
"""

import base64
import json

from mkdocs.structure.files import File

_HEAD = "[This notebook]({name}.ipynb) runs in Jupyter, in a clone with a rig in `out/` ([Ten minutes]({start}))."


def on_files(files, config):
    """Add a page beside every notebook, and its pictures."""
    for file in [file for file in files if file.src_uri.endswith(".ipynb")]:
        place = file.src_uri.removesuffix(".ipynb")
        cells = json.loads(file.content_string)["cells"]
        text, pictures = page(cells, place.split("/")[-1])
        files.append(File.generated(config, f"{place}.md", content=text))
        for name, content in pictures.items():
            files.append(File.generated(config, f"{place.rpartition('/')[0]}/{name}", content=content))
    return files


def page(cells, name):
    """Return the Markdown of a notebook, and its pictures by file name."""
    parts, pictures = [], {}
    for cell in cells:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(f"```python\n{source}\n```")
        for output in cell["outputs"]:
            if "text" in output:
                parts.append(f"```text\n{''.join(output['text']).rstrip()}\n```")
            elif "image/png" in output.get("data", {}):
                picture = f"{name}_{len(pictures)}.png"
                pictures[picture] = base64.b64decode("".join(output["data"]["image/png"]))
                parts.append(f'<div class="picture" markdown>\n![Plot of the cell above]({picture})\n</div>')
    head, _, rest = parts[0].partition("\n")
    parts[0] = "\n\n".join([head, rest.strip(), _HEAD.format(name=name, start="../start/ten-minutes.md")])
    return "\n\n".join(parts) + "\n", pictures
