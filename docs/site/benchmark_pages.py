"""A page for each file of benchmark results, and their index."""

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

ABOUT = """# Benchmarks

Every figure here is read from `benchmarks/results/*.json` when this site is built; none is typed by hand.
`foredrive bench NAME` measures one again. Figures of speed hold for one commit and one machine. "n" is the
number of seeds; with more than one, a figure is the mean ± the standard deviation over seeds. Square brackets
are 95 % intervals where the benchmark computes them. What these figures say about the papers' claims is on
the page [Claims](../claims.md).
"""
LOW, HIGH = "_low", "_high"
"""Endings of the names of a figure's interval."""
NBSP = "\N{NO-BREAK SPACE}"


def benchmark_pages(results: Path) -> dict[str, str]:
    """Return the Markdown of the index and of all pages by their places in the site."""
    pages, rows = {}, []
    for file in sorted(results.glob("*.json")):
        content = json.loads(file.read_text())
        pages[f"benchmarks/{file.stem}.md"] = benchmark_page(content)
        rows.append(
            f"| [{content['name']}]({file.stem}.md) | {content['question']} | {len(content['figures'])} | "
            f"{_seeds(content)} | `{content['commit'][:7]}` |"
        )
    table = "\n".join(["| benchmark | question | arms | n | commit |", "|---|---|---|---|---|", *rows])
    return {"benchmarks/index.md": f"{ABOUT}\n{table}\n"} | pages


def benchmark_page(content: Mapping[str, Any]) -> str:
    """Return the Markdown of a benchmark: its question, where it was measured, and its figures."""
    commits = sorted({run.get("commit", content["commit"])[:7] for run in content["runs"]})
    machine = ("machine.cpu", "machine.cores", "machine.ram_gib", "machine.gpu")
    cpu, cores, ram_gib, gpu = (content[key] for key in machine)
    facts = {
        "command": f"`{_command(content['command'])}`",
        "commit": ", ".join(f"`{commit}`" for commit in commits),
        "machine": f"{cpu}, {cores} cores, {ram_gib} GiB, {gpu or 'no GPU'}",
        "versions": f"Python {content['version.python']}, PyTorch {content['version.torch']}",
        "seeds": _seeds(content),
    }
    rows = "\n".join(f"- {name}: {value}" for name, value in facts.items())
    parts = [
        f"---\nhide: [toc]\nsearch:\n  boost: 0.1\n---\n\n# {content['name']}",
        content["question"],
        rows,
    ]
    parts += [figure_table(content["figures"], arms) for arms in _like_arms(content["figures"])]
    return "\n\n".join(parts) + "\n"


def figure_table(figures: Mapping[str, Mapping[str, Any]], arms: Sequence[str]) -> str:
    """Return the table of some arms: a row for each figure, a column for each arm."""
    names = list(dict.fromkeys(name for arm in arms for name in figures[arm]))
    names = [name for name in names if not _is_bound(name, names)]
    head = f"| figure | {' | '.join(f'`{arm}`' for arm in arms)} |\n|---|{'--:|' * len(arms)}"
    rows = [f"| `{name}` | {' | '.join(cell(figures[arm], name) for arm in arms)} |" for name in names]
    return "\n".join([head, *rows])


def cell(figures: Mapping[str, Mapping[str, float]], name: str) -> str:
    """Return a figure with its spread and its interval, where there are some."""
    if name not in figures:
        return ""
    entry = figures[name]
    text = number(entry["mean"])
    if entry["n"] > 1 and entry["std"]:
        text += f"{NBSP}±{NBSP}{number(entry['std'], digits=2)}"
    if name + LOW in figures and name + HIGH in figures:
        text += f" [{number(figures[name + LOW]['mean'])},{NBSP}{number(figures[name + HIGH]['mean'])}]"
    return text


def number(value: float | None, digits: int = 4) -> str:
    """Return a number with some significant digits, whole numbers in full."""
    if value is None:
        return "\N{EN DASH}"
    if value == int(value) and abs(value) < 1e9:
        return f"{int(value)}"
    return re.sub(r"e([+-])0*", r"e\1", f"{value:.{digits}g}")


def _is_bound(name: str, names: Sequence[str]) -> bool:
    return any(name.endswith(end) and name.removesuffix(end) in names for end in (LOW, HIGH))


def _like_arms(figures: Mapping[str, Mapping[str, Any]]) -> list[list[str]]:
    """Return the arms in groups: arms that share at least half of their figures are in one table."""
    groups: list[list[str]] = []
    for arm, entries in figures.items():
        for group in groups:
            shared = set(entries) & set(figures[group[0]])
            if 2 * len(shared) >= max(len(entries), len(figures[group[0]])):
                group.append(arm)
                break
        else:
            groups.append([arm])
    return groups


def _seeds(content: Mapping[str, Any]) -> str:
    counts = sorted({entry["n"] for arm in content["figures"].values() for entry in arm.values()})
    return str(counts[0]) if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"


def _command(command: str) -> str:
    return command.removeprefix("python -m ").partition(" --arms")[0]
