"""Run the notebooks of docs/notebooks and store what they print: python docs/run_notebooks.py [NAME ...]

They read the rig in `out/` of the repository (`jawusd build examples/capture -o out`) and write nothing there: each
runs in a folder of its own that stands as deep.
"""

import argparse
import os
import shutil
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = ROOT / "docs" / "notebooks"
TIMEOUT_S = 300  # of a cell, on a machine that does other work too


def executed(path: Path, out: Path) -> nbformat.NotebookNode:
    """Return a notebook with the outputs of a run beside the rig of a folder; outputs on stderr are left out.

    Raises:
        nbclient.exceptions.CellExecutionError: a cell failed.
    """
    notebook = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory() as desk:
        folder = Path(desk) / "docs" / "notebooks"
        folder.mkdir(parents=True)
        shutil.copytree(out, Path(desk) / "out")
        os.environ |= {"PYTHONPATH": os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))}
        NotebookClient(notebook, timeout=TIMEOUT_S, resources={"metadata": {"path": str(folder)}}).execute()
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
        if cell.cell_type == "code":
            cell.outputs = merged([output for output in cell.outputs if output.get("name") != "stderr"])
    notebook.metadata.language_info = {"name": "python"}
    return notebook


def merged(outputs: list[nbformat.NotebookNode]) -> list[nbformat.NotebookNode]:
    """Return outputs with what a cell prints in one: kernels send it in pieces, cut by the time of day."""
    found: list[nbformat.NotebookNode] = []
    for output in outputs:
        if found and output.output_type == found[-1].output_type == "stream":
            found[-1].text += output.text
        else:
            found.append(output)
    return found


def printed(notebook: nbformat.NotebookNode) -> list[str]:
    """Return the lines that the cells of a notebook have printed."""
    streams = [output.text for cell in notebook.cells for output in cell.get("outputs", []) if "text" in output]
    return "".join(streams).splitlines()


def main() -> None:
    """Run and store."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = sorted(path.stem for path in NOTEBOOKS.glob("*.ipynb"))
    parser.add_argument("names", nargs="*", metavar="NAME", help="Of: " + ", ".join(names))
    parser.add_argument("--out", type=Path, default=ROOT / "out", help="Folder of the rig.")
    options = parser.parse_args()
    for name in options.names or names:
        path = NOTEBOOKS / f"{name}.ipynb"
        nbformat.write(executed(path, options.out), path)
        print(f"{path}: {path.stat().st_size / 1024:.0f} kB", flush=True)


if __name__ == "__main__":
    main()
