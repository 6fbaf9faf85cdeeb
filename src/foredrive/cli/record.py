"""`foredrive record`."""

import os
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from foredrive.cli.arguments import ImageSize, check_image_size, check_number, check_out_folder, chosen_rig
from foredrive.cli.failures import listed_failures
from foredrive.cli.progress import job_progress
from foredrive.errors import InputError
from foredrive.lazy import importing
from foredrive.towns.map.names import check_town, own_map

if TYPE_CHECKING:
    from foredrive.runs.drive.recording import RecordingResult
    from foredrive.sensors.rigs import RigPlan
    from foredrive.towns.campaign import DrivePlan

SHEET = "contact_sheet.png"
NO_CONDITIONS = "none"
Range = Annotated[str, tyro.conf.arg(metavar="N|FIRST..LAST")]


def record(
    town: Annotated[tuple[str, ...], tyro.conf.arg(metavar="TOWN [TOWN ...]")],
    out: Path,
    seconds: float = 20.0,
    seed: int = 0,
    seeds: Annotated[str | None, tyro.conf.arg(metavar="N|FIRST..LAST")] = None,
    rate: Annotated[float, tyro.conf.arg(metavar="HZ")] = 10.0,
    rig: Annotated[str, tyro.conf.arg(metavar="NAME|FILE.yaml")] = "surround",
    image_size: ImageSize | None = None,
    vehicles: Range = "30",
    people: Range = "20",
    conditions: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME [NAME ...]")] = (),
    virtual_egos: int = 0,
    occupancy: bool = False,
    lidar: bool = False,
    workers: int = 0,
    ray: bool = False,
) -> None:
    """Record drives through towns as 123D logs with exact labels.

    A single drive is recorded in this process. Several drives (towns, conditions or seeds) are recorded in
    parallel. Complete logs are skipped, and a contact sheet shows all drives at the end.

    Args:
        town: Town01 to Town07, Town10HD or Town15, or a tile of Town11 to Town13 such as Town12_Tile_4_-16;
            Town05, Town13 and Town15 are held out for testing. Or the path of a road map (.xodr).
        out: 123D data root; logs and the towns' maps are written into it.
        seconds: Length of each drive, s.
        seed: Seed of the buildings, the route, the traffic and all noise; the same seed gives the same bytes.
        seeds: Instead of one seed: a range FIRST..LAST, or the number of drives in each town and condition.
            For a number, seeds are chosen whose routes turn left, turn right and go straight equally often.
        rate: Frames per second.
        rig: Cameras of the vehicle: surround (six in all directions), driving (the same and a narrow one for
            traffic lights), front_tele (two front cameras), navsim (eight, of nuPlan's size), or a YAML file
            of image_hw and cameras.
        image_size: Size of the images (height, width), px; by default the rig's.
        vehicles: Number of vehicles on the road near the ego vehicle; from a range, drawn for each drive.
        people: Number of pedestrians, where the town has walkways; from a range, drawn for each drive.
        conditions: clear, morning, overcast, dusk, night, rain, night_rain or fog: every drive under each;
            any: one for each drive, evenly; none: a bright day.
        virtual_egos: In place of drives, this many short logs for each town and seed. In each, another car
            of the traffic is the recording vehicle: six key frames of images, then 4 s of boxes. --seconds,
            --rate, --vehicles and --people do not apply.
        occupancy: Record exact occupancy with flow for virtual egos too, to pre-train world models on them.
            Drives always have it.
        lidar: Record lidar sweeps of virtual egos too. Drives always have them.
        workers: Number of drives recorded at a time; 0: one for each core.
        ray: Record on Ray: on the cluster at RAY_ADDRESS, or on a cluster that is started here.
    """
    check_number("--seconds", seconds, above=0)
    check_number("--seed", seed, low=0)
    check_number("--rate", rate, above=0)
    check_image_size(image_size)
    check_number("--virtual-egos", virtual_egos, low=0)
    for name, asked in (("--occupancy", occupancy), ("--lidar", lidar)):
        if asked and not virtual_egos:
            raise InputError(f"{name} belongs to --virtual-egos; drives always have it")
    check_number("--workers", workers, low=0)
    check_out_folder(out)
    between = _range("vehicles", vehicles), _range("people", people)
    some_seeds = (seed,) if seeds is None else _seeds(seeds)
    weather = _conditions(conditions)
    for name in town:
        check_town(name)
        _tell_left_out(name)
    cameras = chosen_rig(rig, image_size)

    with importing():
        from foredrive.runs.drive.recording import record_drives, record_plan
        from foredrive.towns.campaign import Campaign, plan_drives

    if virtual_egos:
        recorded = occupancy, lidar
        _record_egos(town, some_seeds, weather, virtual_egos, recorded, out, cameras, workers, ray)
        return
    plans = plan_drives(Campaign(town, some_seeds, weather, *between, seconds=seconds, rate_hz=rate))
    # A single drive is recorded without worker processes
    if len(plans) == 1 and not ray:
        log = record_plan(plans[0], out, cameras)
        print(f"wrote {log.folder}")
        print(f"next: foredrive view {log.folder} --save {log.folder.name}.png")
        return
    workers = workers or len(os.sched_getaffinity(0))
    with job_progress("recording drives", len(plans)) as tick:
        done = record_drives(plans, out, cameras, workers, on_ray=ray, tick=tick)
    _tell(done, plans, out)


def _tell_left_out(town: str) -> None:
    """Print what of a road map of one's own is not read."""
    file = own_map(town)
    if file is None:
        return
    with importing():
        from foredrive.towns.map.own_maps import left_out

    if missing := left_out(file):
        print(f"{file}: not read: {missing}")


def _record_egos(
    towns: tuple[str, ...],
    seeds: tuple[int, ...] | int,
    conditions: tuple[str, ...],
    count: int,
    recorded: tuple[bool, bool],
    out: Path,
    rig: "RigPlan",
    workers: int,
    ray: bool,
) -> None:
    """Record virtual egos of each town and seed, and print the results.

    Args:
        recorded: whether to record occupancy, and lidar.

    Raises:
        InputError: some failed.
    """
    from foredrive.runs.drive.recording import EgosPlan, record_egos
    from foredrive.scene.conditions import ANY_CONDITIONS, CONDITIONS

    some = tuple(CONDITIONS) if conditions == (ANY_CONDITIONS,) else conditions
    numbers = range(seeds) if isinstance(seeds, int) else seeds
    plans = [
        EgosPlan(town, seed, count, some, *recorded) for town in dict.fromkeys(towns) for seed in numbers
    ]
    with job_progress("recording virtual egos", len(plans)) as tick:
        logs, failed = record_egos(
            plans, out, rig, workers or len(os.sched_getaffinity(0)), on_ray=ray, tick=tick
        )
    if logs:
        print(f"{len(logs)} logs in {logs[0].folder.parent}")
    if failed:
        raise InputError(f"{len(failed)} of {len(plans)} failed: {listed_failures(failed)}")


def _tell(done: "RecordingResult", plans: "list[DrivePlan]", out: Path) -> None:
    """Print the recorded drives, write the contact sheet, and report the failed drives last.

    Raises:
        InputError: some drives failed.
    """
    from foredrive.view.contact_sheet import write_contact_sheet

    print(f"recorded {len(done.logs) - done.skipped} drives, {done.skipped} had been recorded before")
    if done.logs:
        write_contact_sheet(out / SHEET, [(log, _caption(plan)) for plan, log in done.logs.items()])
        print(f"contact sheet: {out / SHEET}")
    if done.failed:
        failures = listed_failures({plan.log_name: reason for plan, reason in done.failed.items()})
        raise InputError(f"{len(done.failed)} of {len(plans)} drives failed: {failures}")


def _caption(plan: "DrivePlan") -> str:
    return f"{plan.conditions or 'daylight'}\n{plan.vehicles} vehicles, {plan.people} people"


def _seeds(text: str) -> tuple[int, ...] | int:
    """Return the seeds of a range, or the number of seeds."""
    first, last = _range("seeds", text)
    return tuple(range(first, last + 1)) if ".." in text else first


def _conditions(names: tuple[str, ...]) -> tuple[str, ...]:
    """Check the names of conditions and return them; "none" alone gives no names."""
    from foredrive.scene.conditions import ANY_CONDITIONS, find_conditions

    if names in ((NO_CONDITIONS,), (ANY_CONDITIONS,)):
        return () if names == (NO_CONDITIONS,) else names
    for name in names:
        if name in (NO_CONDITIONS, ANY_CONDITIONS):
            raise InputError(
                f"--conditions {name} cannot be combined with other names, got {' '.join(names)}"
            )
        find_conditions(name)
    return names


def _range(what: str, text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+)(?:\.\.(\d+))?", text)
    if match is None or (match[2] is not None and int(match[2]) < int(match[1])):
        raise InputError(f"--{what} must be a number or a range such as 1..8, got {text!r}")
    return int(match[1]), int(match[2] or match[1])
