"""A page for each file of benchmark results, and their index."""

import json
import os
import re
import subprocess
import sys
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

ABOUT = """# Benchmarks

Every figure here is read from `benchmarks/results/*.json` when this site is built; none is typed by hand.
`foredrive bench NAME` measures one again. Figures of speed hold for one commit and one machine. "n" is the
number of seeds; with more than one, a figure is the mean ± the standard deviation over seeds. Square brackets
are 95 % intervals where the benchmark computes them. Long pages begin with the figures that decide the
question; the others are folded. What these figures say about the papers' claims is on the page
[Claims](../claims.md).
"""
LONG, WIDE = 20, 6
"""Rows of a page, and columns of a table, that are not too many to be read at once."""
DECIDING = {
    "demo": "wall_min seen.occupancy.above_ground.iou_now learned.occupancy.above_ground.iou_now "
    "driven.driving_score_1_0 rebuilt.psnr_db improved.round_1.driving_score_1_0",
    "domain-gap": "lidar.drop_pct lidar.range_p50_m lidar.intensity_p50 image.brightness image.gradient",
    "drive-expert": "ds_short rc_short ds_long rc_long",
    "drive-nemo": "ds_short red_lights_short collisions_short ds_long ds_unseen_short ds_unseen_long",
    "driveworld-ablation": "occupancy_iou l2_m ego_mlp.uniad.l2_avg_m collision_pct",
    "driveworld-forecast": "above_ground.iou_now above_ground.iou_future_1s above_ground.iou_future_1s.copy "
    "above_ground.iou_future_1s.carried_copy occupancy.above_ground.iou_now "
    "occupancy.above_ground.iou_future_1s occupancy.above_ground.iou_future_1s.copy "
    "occupancy.above_ground.iou_future_1s.carried_copy",
    "improve": "ds conflict_recall light_accuracy_40m red_missed_40m",
    "learning": "iou_10min iou_30min samples_per_cpu_s samples_per_cpu_s_ratio",
    "ncap": "score collision_rate progress score_progress",
    "ncap-transfer": "pairs collision_agreement kappa score_in_town score_in_rebuild score_correlation",
    "nemo-ablation": "l2_m ego_mlp.uniad.l2_avg_m collision_pct above_ground.iou_now",
    "nemo-base": "forward_cpu_s peak_gib fast.step_cpu_s fast.peak_gib speedup_over_reference",
    "nemo-futures": "occupancy.moving.iou_now occupancy.moving.iou_future_1s "
    "occupancy.moving.iou_future_1s.continued_copy occupancy.moving.iou_future_1s.ceiling "
    "occupancy.standing.iou_future_1s occupancy.standing.iou_future_1s.continued_copy "
    "occupancy.standing.iou_future_1s.ceiling share.moving_pct",
    "ranking": "coverage_min coverage_mean coverage.2_agents_16_routes coverage.10_agents_56_routes",
    "real-to-sim": "real.occupancy.iou_now rendered.occupancy.iou_now real.occupancy.above_ground.iou_now "
    "rendered.occupancy.above_ground.iou_now real.planning.uniad.l2_avg_m rendered.planning.uniad.l2_avg_m",
    "rebuild-compare": "computing_minutes psnr_db depth_median_sq_m2 chamfer_m2 psnr_3m_aside_db "
    "points.3m_aside.psnr_db",
    "rebuild-town": "held_out.psnr_db left_3m.psnr_db right_3m.psnr_db removed.changed.psnr_db "
    "moved.changed.psnr_db",
    "search-retrieval": "all.every.p_at_10 clear.every.p_at_10 night.every.p_at_10 rain.every.p_at_10 "
    "fog.every.p_at_10",
    "search-zero-shot": "objects.accuracy.image objects.accuracy.lidar objects.accuracy.joint "
    "objects.accuracy.chance",
    "sets-speed": "ms_900x200_k25 speedup_over_scipy_murty_900x200 ms_900x200_k1 validation_size_s",
    "task-metrics": "tracking_speedup detection_speedup rayiou_speedup validation_cpu_s "
    "detection.nuscenes.nds detection.vad.nds tracking.nuscenes.amota tracking.uniad.amota "
    "predicted.occ3d.miou_pct predicted.sparseocc.miou_pct",
    "task-pandaset": "detection.nuscenes.map detection.car_ap_2m_30m motion.uniad.car.min_ade_m "
    "motion.uniad.car.min_ade_m.constant_velocity",
    "task-probes": "detection.nuscenes.map tracking.nuscenes.amota motion.uniad.car.min_ade_m "
    "map.uniad.iou_lanes occupancy.occ3d.miou_pct occupancy.uniad.iou_near_pct",
    "wide-grid": "occupancy.above_ground.iou_now occupancy.above_ground.iou_future_1s "
    "occupancy.above_ground.iou_future_1s.continued_copy occupancy.moving.iou_future_1s "
    "occupancy.moving.iou_future_1s.continued_copy detection.car_ap_2m_30m map.maptr.map "
    "occupancy.uniad.vpq_near_pct occupancy.uniad.vpq_near_pct.constant_velocity",
    "town-maps": "lane_max_m height_p95_m width_max_m heading_p95_deg links_equal_pct lights_equal_pct",
    "trust": "psnr_held_out_db psnr_db calibration_error_db correlation good_of_trusted psnr_trusted_db "
    "psnr_untrusted_db detection_f1_trusted detection_f1_untrusted",
}
"""The keys of the figures that decide the question of a long page."""
UNITS = {unit: unit for unit in ("m", "s", "ms", "mm", "rad", "nats")} | {
    "m2": "m²",
    "pct": "%",
    "mps": "m/s",
    "kmph": "km/h",
    "hz": "Hz",
    "db": "dB",
    "mib": "MiB",
    "gib": "GiB",
}
ACRONYMS = (
    "AP NDS ATE ASE AOE AVE mAVE AAE AMOTA AMOTP MOTA MOTP MOTAR TP FP FN GT MT ML FAF IDS TID LGD EPA "
    "ADE FDE VPQ IoU mIoU RayIoU L2 PSNR SSIM LPIPS FID RMSE AUC ECE NLL PMB MLP RSS CPU JPEG EPE F1 UniAD "
    "VAD SparseDrive nuScenes Occ3D OpenOcc SparseOcc MapTR StreamMapNet NeMo SciPy"
)
WORDS = {word.lower(): word for word in ACRONYMS.split()} | {
    "stp3": "ST-P3",
    "bevplanner": "BEV-Planner",
    "ds": "driving score",
    "rc": "route completion",
    "future": "in",
    "avg": "mean",
    "sq": "squared",
    "pgospa": "P-GOSPA",
    "flops": "FLOP",
    "gflops": "GFLOP",
    "murty": "Murty",
    "mp": "megapixels",
    "mrays": "million rays",
    "krays": "thousand rays",
    "mpoints": "million points",
}
"""Words of keys that are written otherwise."""
BASELINES = {
    "copy": "persistence",
    "carried_copy": "ego-compensated persistence",
    "continued_copy": "persistence, motion continued",
    "best_constant": "the best constant",
    "ceiling": "ceiling",
    "greedy_association": "greedy association",
}
"""Endings of keys that name a baseline, in the glossary's words."""
BOUNDS = ("low", "high")
"""Words in the names of a figure's interval."""
NBSP = "\N{NO-BREAK SPACE}"
QUANTITY = re.compile(r"(-?[\d.]+)(ms|mps|min|deg|m|s|h)")


def arms_of_today(root: Path) -> dict[str, set[str]]:
    """Return the arms of a checkout's benchmarks by benchmark, as `foredrive bench` lists them."""
    paths = os.pathsep.join([str(root / "src"), *filter(None, [os.environ.get("PYTHONPATH")])])
    listed = subprocess.run(
        [sys.executable, "-m", "foredrive", "bench"],
        cwd=root,
        env=os.environ | {"PYTHONPATH": paths},
        check=True,
        capture_output=True,
        text=True,
    ).stdout
    benchmarks = re.findall(r"^(\S+): .*\n    arms: (.*)$", listed, flags=re.MULTILINE)
    return {name: {arm.partition("@")[0] for arm in arms.split(", ")} for name, arms in benchmarks}


def benchmark_pages(results: Path, arms: Mapping[str, Collection[str]] | None = None) -> dict[str, str]:
    """Return the Markdown of the index and of all pages by their places in the site.

    Args:
        results: folder of the results.
        arms: arms by benchmark. Other arms and benchmarks are left out; None leaves out nothing.
    """
    pages, rows = {}, []
    for file in sorted(results.glob("*.json")):
        content = json.loads(file.read_text())
        if arms is not None:
            known = arms.get(content["name"], ())
            content["figures"] = {arm: figures for arm, figures in content["figures"].items() if arm in known}
        if not content["figures"]:
            continue
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
        "machine": f"{cpu}, {cores} {'core' if cores == 1 else 'cores'}, {ram_gib} GiB, {gpu or 'no GPU'}",
        "versions": f"Python {content['version.python']}, PyTorch {content['version.torch']}",
        "seeds": _seeds(content),
    }
    rows = "\n".join(f"- {name}: {value}" for name, value in facts.items())
    parts = [
        f"---\nhide: [toc]\nsearch:\n  boost: 0.1\n---\n\n# {content['name']}",
        content["question"],
        rows,
    ]
    figures = content["figures"]
    groups = [(arms, _names(figures, arms)) for arms in _like_arms(figures)]
    folded = sum(len(names) for _, names in groups) > LONG
    if folded:
        deciding = DECIDING.get(content["name"], "").split()
        parts += ["## In short", *deciding_tables(figures, deciding)] if deciding else []
        parts.append("## All figures")
    for arms, names in groups:
        of = f": {_listed(arms)}" if len(groups) > 1 else ""
        for title, sections in _sections(names).items():
            parts.append(_shown(title, of, figure_table(figures, arms, sections), folded=folded))
    return "\n\n".join(parts) + "\n"


def deciding_tables(figures: Mapping[str, Mapping[str, Any]], keys: Sequence[str]) -> list[str]:
    """Return the tables of a few figures: a row for each arm, or for each figure if no two arms share one."""
    arms = {key: [arm for arm in figures if key in figures[arm]] for key in keys}
    if all(len(having) == 1 for having in arms.values()):
        rows = [
            f"| {_whole_name(key, figures[arm])} | `{arm}` | {cell(figures[arm], key)} |"
            for key, (arm,) in arms.items()
        ]
        return ["\n".join(["| figure | arm | |", "|---|---|--:|", *rows])]
    groups = _like_arms(figures) if len(keys) > WIDE else [list(figures)]
    tables = []
    for group in groups:
        shown = [key for key in keys if set(arms[key]) & set(group)]
        having = [arm for arm in group if any(key in figures[arm] for key in shown)]
        if shown:
            tables.append(arm_table(figures, having, shown))
    return tables


def figure_table(
    figures: Mapping[str, Mapping[str, Any]], arms: Sequence[str], sections: Mapping[str, Sequence[str]]
) -> str:
    """Return the table of some arms: a row for each figure under the heading of its section.

    Args:
        figures: figures by arm.
        arms: a column for each; a row for each if there are more arms than figures.
        sections: names of figures by heading, "" for none.
    """
    names = [name for section in sections.values() for name in section]
    if len(arms) > len(names):
        return arm_table(figures, arms, names)
    rows = []
    for heading, section in sections.items():
        if heading:
            rows.append(f"| **{heading}** |{' |' * len(arms)}")
        for name in section:
            rows.append(f"| {_label(name, names)} | {' | '.join(cell(figures[arm], name) for arm in arms)} |")
    head = f"| | {' | '.join(f'`{arm}`' for arm in arms)} |\n|---|{'--:|' * len(arms)}"
    return "\n".join([head, *rows])


def arm_table(figures: Mapping[str, Mapping[str, Any]], arms: Sequence[str], names: Sequence[str]) -> str:
    """Return the table of some figures by their whole names: a row for each arm, or figure if more."""
    every = {name for arm in arms for name in figures[arm]}
    heads, codes = [_whole_name(name, every) for name in names], [f"`{arm}`" for arm in arms]
    cells = [[cell(figures[arm], name) for name in names] for arm in arms]
    if len(arms) < len(names):
        heads, codes, cells = codes, heads, [list(row) for row in zip(*cells, strict=True)]
    rows = [f"| {code} | {' | '.join(row)} |" for code, row in zip(codes, cells, strict=True)]
    return "\n".join([f"| | {' | '.join(heads)} |", f"|---|{'--:|' * len(heads)}", *rows])


def cell(figures: Mapping[str, Mapping[str, float]], name: str) -> str:
    """Return a figure with its spread and its interval, where there are some."""
    if name not in figures:
        return ""
    entry = figures[name]
    text = number(entry["mean"])
    if entry["n"] > 1 and entry["std"]:
        text += f"{NBSP}±{NBSP}{number(entry['std'], digits=2)}"
    low, high = (_bound(name, end, figures) for end in BOUNDS)
    if low and high:
        text += f" [{number(figures[low]['mean'])},{NBSP}{number(figures[high]['mean'])}]"
    return text


def number(value: float | None, digits: int = 4) -> str:
    """Return a number with some significant digits, whole numbers in full."""
    if value is None:
        return "\N{EN DASH}"
    if value == int(value) and abs(value) < 1e9:
        return f"{int(value)}"
    return re.sub(r"e([+-])0*", r"e\1", f"{value:.{digits}g}")


def figure_name(part: str) -> tuple[str, str]:
    """Return a part of a key in words, and its unit ("" for none).

    A word of a unit is the unit wherever it stands, unless the figure is a rate.
    """
    words = part.split("_")
    unit = ""
    if "per" not in words:
        at = next((i for i in range(len(words) - 1, -1, -1) if words[i] in UNITS), None)
        if at is not None and len(words) > 1:
            unit = UNITS[words.pop(at)]
    text = " ".join(map(_word, words)).replace("score 2 1", "score 2.1").replace("PMB NLL", "PMB-NLL")
    if unit in ("s", "ms"):
        text = text.replace("CPU", "CPU time")
    return re.sub(r"\b(p|recall) at (?=\d)", lambda match: f"{match[1]}@".replace("p@", "P@"), text), unit


def _word(word: str) -> str:
    match = QUANTITY.fullmatch(word)
    if match is None:
        return WORDS.get(word, word)
    digits, unit = match.groups()
    if re.fullmatch(r"0\d", digits):  # 05s is half a second
        digits = f"0.{digits[1]}"
    if unit == "min":
        return f"after {digits}{NBSP}min"
    return f"{digits}°" if unit == "deg" else f"{digits}{NBSP}{UNITS.get(unit, unit)}"


def _parts(key: str) -> list[str]:
    """Return the parts of a key, which are joined by dots; 0.5 is no two parts."""
    return re.split(r"(?<!\d)\.|\.(?!\d)", key)


def _figure(key: str, keys: Collection[str]) -> str:
    """Return the figure that a key belongs to: itself, or that of which it is a baseline."""
    parts = _parts(key)
    while len(parts) > 1 and (parts[-1] in BASELINES or ".".join(parts[:-1]) in keys):
        parts.pop()
    return ".".join(parts)


def _label(key: str, keys: Collection[str]) -> str:
    """Return the name of a figure without its group, with its unit, as a row begins."""
    return _capital(_words(key, keys))


def _words(key: str, keys: Collection[str]) -> str:
    figure = _figure(key, keys)
    leaf = _parts(figure)[-1]
    text, unit = ("mAP", "") if leaf == "map" else figure_name(leaf)
    if baseline := key[len(figure) + 1 :]:
        text += f", {BASELINES.get(baseline) or figure_name(baseline)[0]}"
    return f"{text}, {unit}" if unit else text


def _whole_name(key: str, keys: Collection[str]) -> str:
    """Return the name of a figure with its group."""
    group = _group(key, keys)
    return f"{_title(group)}: {_words(key, keys)}" if group else _label(key, keys)


def _group(key: str, keys: Collection[str]) -> str:
    return ".".join(_parts(_figure(key, keys))[:-1])


def _title(group: str) -> str:
    """Return the heading of a group of keys."""
    names = [", ".join(filter(None, figure_name(part))) for part in _parts(group)]
    return _capital(" · ".join(names))


def _capital(text: str) -> str:
    """Return a text with a capital at its beginning, but for names such as nuScenes and mAP."""
    own = text.partition(" ")[0].rstrip(",") in (*WORDS.values(), "mAP")
    return text if own else text[:1].upper() + text[1:]


def _sections(names: Sequence[str]) -> dict[str, dict[str, list[str]]]:
    """Return figures by the first part of their keys, and in these by the other parts before the last.

    The baselines of a figure follow it.
    """
    by_figure: dict[str, list[str]] = {}
    for name in names:
        by_figure.setdefault(_figure(name, names), []).append(name)
    sections: dict[str, dict[str, list[str]]] = {}
    for figure, keys in by_figure.items():
        first, _, rest = _group(figure, names).partition(".")
        title = _title(first) if first else "Overall"
        sections.setdefault(title, {}).setdefault(_title(rest) if rest else "", []).extend(keys)
    return sections


def _shown(title: str, of: str, table: str, *, folded: bool) -> str:
    """Return a section of a page, folded or below a heading. Folded ones name their arms (`of`)."""
    if not folded:
        return f"## {title}\n\n{table}" if title != "Overall" else table
    indented = "\n".join(f"    {line}" for line in table.splitlines())
    return f'??? abstract "{title}{of}"\n\n{indented}'


def _listed(arms: Sequence[str], most: int = 3) -> str:
    more = f" and {len(arms) - most} more" if len(arms) > most else ""
    return ", ".join(arms[:most]) + more


def _names(figures: Mapping[str, Mapping[str, Any]], arms: Sequence[str]) -> list[str]:
    """Return the names of the figures of some arms, without the bounds of intervals."""
    names = dict.fromkeys(name for arm in arms for name in figures[arm])
    bounds = {_bound(name, end, names) for name in names for end in BOUNDS}
    return [name for name in names if name not in bounds]


def _bound(name: str, end: str, names: Collection[str]) -> str | None:
    """Return the name of a bound of a figure: ds_low_short is one of ds_short."""
    ending = re.compile(rf"_{end}(?=_|$)")
    return next((key for key in names if key != name and ending.sub("", key, count=1) == name), None)


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
    return command.removeprefix("python -m ").partition(" --")[0]
