"""The tutorials: notebooks in docs/tutorials (py:percent), executed when the site is built."""

import base64
import os
import resource
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

import jupytext
import nbformat
from nbclient import NotebookClient
from nbconvert.exporters import MarkdownExporter

COMPUTING_MIN_AT_MOST = 10.0
"""Five minutes of two cores. Computing time is the same on a busy machine."""
HANGS_S = 3600
"""Time after which a cell counts as hanging, s."""
WEBP = "image/webp"
PLAIN_TEXT = "import os\n\nos.environ |= {'TERM': 'dumb'}\nos.environ.pop('FORCE_COLOR', None)"
"""Run before each notebook: kernels ask programs for colours and for bars that move."""


def tutorial_pages(folder: Path, root: Path) -> Mapping[str, str | bytes]:
    """Run all notebooks; return their pages and pictures by their places in the site.

    With TUTORIALS=no in the environment they are shown as they are, without running them.

    Raises:
        CellExecutionError: a cell failed.
        CellTimeoutError: a cell hangs.
        RuntimeError: a notebook computed for longer than it may.
    """
    pages: dict[str, str | bytes] = {}
    for file in sorted(folder.glob("*.py")):
        notebook = jupytext.read(file)
        if os.environ.get("TUTORIALS") != "no":
            before = _computing_min()
            _execute(notebook, root)
            took = _computing_min() - before
            print(f"tutorial {file.stem}: {took:.1f} min of computing")
            if took > COMPUTING_MIN_AT_MOST:
                raise RuntimeError(f"{file}: more than {COMPUTING_MIN_AT_MOST:.0f} min of computing")
        films = _films_in_files(notebook, file.stem)
        text, resources = MarkdownExporter().from_notebook_node(
            notebook, {"output_files_dir": f"{file.stem}_files"}
        )
        pages[f"tutorials/{file.stem}.md"] = text
        pages |= {f"tutorials/{name}": picture for name, picture in resources["outputs"].items()}
        pages |= {f"tutorials/{name}": film for name, film in films.items()}
    return pages


def _films_in_files(notebook: nbformat.NotebookNode, stem: str) -> dict[str, bytes]:
    """Replace outputs of animated WebP, which the exporter leaves out, by pictures; return their files."""
    films = {}
    for cell in notebook.cells:
        for output in cell.get("outputs", []):
            if (encoded := output.get("data", {}).pop(WEBP, None)) is not None:
                name = f"{stem}_files/film_{len(films)}.webp"
                films[name] = base64.b64decode(encoded)
                output["data"]["text/html"] = f'<img src="{name}" alt="film">'
    return films


def _computing_min() -> float:
    """Return the computing time of all programs that have ended under this one, min."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return (used.ru_utime + used.ru_stime) / 60


def _execute(notebook: nbformat.NotebookNode, root: Path) -> None:
    """Run a notebook in a folder of its own, with the package of this checkout."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    environment = os.environ | {"PYTHONPATH": str(root / "src"), "PATH": path, "COLUMNS": "96"}
    notebook.cells.insert(0, nbformat.v4.new_code_cell(PLAIN_TEXT))
    with tempfile.TemporaryDirectory() as here:
        resources = {"metadata": {"path": here}}
        client = NotebookClient(notebook, timeout=HANGS_S, resources=resources, coalesce_streams=True)
        client.execute(env=environment)
    notebook.cells.pop(0)
    for (
        cell
    ) in notebook.cells:  # an error has ended the build already; the rest of stderr is of no use to readers
        cell["outputs"] = [out for out in cell.get("outputs", []) if out.get("name") != "stderr"]
