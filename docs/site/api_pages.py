"""The API reference: a page for each public module, from its docstrings."""

import ast
import re
from pathlib import Path

FOLDERS = {
    "scene": "The types that every part reads, and the protocols between the parts",
    "data": "Logs, clips, labels; writing logs",
    "runs": "Train, evaluate, drive, reconstruct, search and score",
    "methods": "Published methods: configuration, network, loss, training and recipes",
    "tasks": "Heads, losses, metrics, protocols and files of results, a folder for each task",
    "sets": "Random finite sets",
    "ops": "Kernels, each beside its reference in plain PyTorch",
    "driving": "The closed loop",
    "towns": "The embedded world",
    "driver": "A driver by sight",
    "search": "Towers, index, queries",
    "engine": "Training loops, checkpoints, run folders, benchmarks",
    "integrations": "Other simulators, planners and file formats",
    "view": "Pictures, reports, pages in the browser",
}
"""Documented folders of the package, in the order of the index."""
ABOUT = """# API

What can be imported and relied on. `foredrive.FOLDER` exports what stands after *exports*; other modules are
imported by their own names. Shapes stand in the types ([jaxtyping](https://docs.kidger.site/jaxtyping)),
frames and units in the names ([conventions](../conventions.md))."""
KERNELS = re.compile(r".*_(kernels|triton|numba|gsplat)$")
"""Matches modules of ops/ that their reference modules call; they are not public."""


def api_pages(package: Path) -> dict[str, str]:
    """Return the Markdown of all pages of the reference by their places in the site.

    A folder whose `__init__.py` has `__all__` exports that. In any other folder, the names of each module
    without a leading underscore are public.
    """
    index = [ABOUT]
    pages = {}
    for folder, about in FOLDERS.items():
        exported = _exported(package / folder / "__init__.py")
        modules = _modules(package, folder)
        index += [f"## foredrive.{folder}", f"{about}."]
        if exported:
            pages[f"api/{folder}.md"] = _page(f"foredrive.{folder}", exported)
            links = [f"[`{name}`]({folder}.md#foredrive.{folder}.{name})" for name in exported]
            index.append(f"Exports: {', '.join(links)}.")
        rows = []
        for module, doc in modules.items():
            name = f"foredrive.{module}"
            pages[f"api/{module}.md"] = _page(name)
            rows.append(f"| [`{module}`]({module}.md) | {doc} |")
        index.append("\n".join(["| module | content |", "|---|---|", *rows]))
    return {"api/index.md": "\n\n".join(index) + "\n"} | pages


def _page(name: str, members: list[str] | None = None) -> str:
    options = f"\n    options:\n      members: [{', '.join(members)}]" if members else ""
    return f"---\ntitle: {name}\nsearch:\n  boost: 0.1\n---\n\n::: {name}{options}\n"


def _exported(init: Path) -> list[str]:
    for node in ast.parse(init.read_text()).body:
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", None) == "__all__":
            return list(ast.literal_eval(node.value))
    return []


def _modules(package: Path, folder: str) -> dict[str, str]:
    """Return the first sentences of the public modules of a folder by their dotted names."""
    found = {}
    for path in sorted((package / folder).rglob("*.py")):
        if path.name.startswith("_") or KERNELS.fullmatch(path.stem):
            continue
        doc = ast.get_docstring(ast.parse(path.read_text())) or ""
        sentence = " ".join(doc.split("\n\n")[0].split())
        found[".".join(path.relative_to(package).with_suffix("").parts)] = sentence.replace("|", "\\|")
    return found
