"""The tutorials: notebooks in docs/tutorials (py:percent), executed when the site is built."""

import os
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

import jupytext
from nbclient import NotebookClient
from nbconvert.exporters import MarkdownExporter

MINUTES_AT_MOST = 5


def tutorial_pages(folder: Path, root: Path) -> Mapping[str, str | bytes]:
    """Run all notebooks; return their pages and pictures by their places in the site.

    With TUTORIALS=no in the environment they are shown as they are, without running them.

    Raises:
        CellExecutionError: a cell failed.
        CellTimeoutError: a cell took longer than a whole notebook may.
    """
    pages: dict[str, str | bytes] = {}
    for file in sorted(folder.glob("*.py")):
        notebook = jupytext.read(file)
        if os.environ.get("TUTORIALS") != "no":
            _execute(notebook, root)
        text, resources = MarkdownExporter().from_notebook_node(
            notebook, {"output_files_dir": f"{file.stem}_files"}
        )
        pages[f"tutorials/{file.stem}.md"] = text
        pages |= {f"tutorials/{name}": picture for name, picture in resources["outputs"].items()}
    return pages


def _execute(notebook: jupytext.jupytext.NotebookNode, root: Path) -> None:
    """Run a notebook in a folder of its own, with the package of this checkout."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    environment = os.environ | {
        "PYTHONPATH": str(root / "src"),
        "PATH": path,
        "COLUMNS": "96",
        "NO_COLOR": "1",
    }
    with tempfile.TemporaryDirectory() as here:
        resources = {"metadata": {"path": here}}
        client = NotebookClient(notebook, timeout=60 * MINUTES_AT_MOST, resources=resources)
        client.execute(env=environment)
    for (
        cell
    ) in notebook.cells:  # an error has ended the build already; the rest of stderr is of no use to readers
        cell["outputs"] = [out for out in cell.get("outputs", []) if out.get("name") != "stderr"]
