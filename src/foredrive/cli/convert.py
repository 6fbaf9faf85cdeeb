"""`foredrive convert`."""

import os
from pathlib import Path
from typing import Annotated

import tyro

from foredrive.cli.arguments import OptionalPath, check_number, check_out_folder
from foredrive.cli.failures import listed_failures
from foredrive.cli.progress import frame_progress
from foredrive.errors import InputError
from foredrive.lazy import importing


def convert(
    dataset: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="DATASET")],
    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")],
    out: OptionalPath = None,
    workers: int = 0,
    overwrite: bool = False,
    topics: OptionalPath = None,
    propose: bool = False,
    ray: bool = False,
) -> None:
    """Convert a raw data set into 123D logs.

    Existing logs are kept, so an interrupted conversion continues where it stopped. A log that cannot be read
    does not stop the others.

    Args:
        dataset: Name of the data set: pandaset, av2, nuscenes, nuscenes-sweeps (10 Hz), nuplan, waymo,
            waymo-motion, kitti360, kitti-raw, kitti-object, griffin, truckdrive, physical-ai-av, ncore (NCore
            v4), nureasoning, nerfstudio (folders with transforms.json) or rosbag (ROS 1, ROS 2 and MCAP).
            Some need more packages; the message says which.
        source: Folder of one raw log, or of many; for rosbag also a file.
        out: 123D data root to write to.
        workers: Number of logs converted at a time; 0: one for each core.
        overwrite: Convert logs again that exist already.
        topics: YAML that says which topics of a bag are cameras, lidar and poses; by default the bag's name
            with .topics.yaml, beside it.
        propose: Write this YAML from what the bag holds, and convert nothing.
        ray: Convert on Ray: on the cluster at RAY_ADDRESS, or on a cluster that is started here.
    """
    check_number("--workers", workers, low=0)
    check_out_folder(out)
    is_bag = dataset == "rosbag"
    if not (source.exists() if is_bag else source.is_dir()):
        raise InputError(f"{source}: no such {'bag' if is_bag else 'folder'}")
    if (propose or topics) and not is_bag:
        raise InputError("--propose and --topics are for rosbag")
    if propose:
        _propose(source, topics)
        return
    if out is None:
        raise InputError("convert needs --out: the data root to write to")

    with importing():
        from foredrive.data.notices import read_notices
        from foredrive.runs.convert import convert_all

    failed, count = {}, 0
    with frame_progress(f"converting {dataset}") as tick:
        cores = workers or len(os.sched_getaffinity(0))
        for done in convert_all(
            source, dataset, out, cores, overwrite=overwrite, topics=topics, on_ray=ray, tick=tick
        ):
            count += 1
            if done.log is None:
                failed[done.name] = done.failure or ""
            else:
                kept = " (was there; --overwrite converts it again)" if done.kept else ""
                print(f"{'kept' if done.kept else 'wrote'} {done.log.folder}{kept}", flush=True)
                for notice in read_notices(done.log.folder):
                    print(f"  {notice}", flush=True)
    if failed and count == 1:
        raise InputError(next(iter(failed.values())))
    if failed:
        raise InputError(f"{len(failed)} of {count} logs failed: {listed_failures(failed)}")


def _propose(bag: Path, topics: Path | None) -> None:
    with importing():
        from foredrive.data.formats.bag_proposal import propose_topics
        from foredrive.data.formats.bag_topics import topics_file
        from foredrive.data.formats.guard import reading_raw

    file = topics or topics_file(bag)
    with reading_raw(bag):
        print(propose_topics(bag, file))
    print(f"wrote {file}; check it, then: foredrive convert rosbag {bag} --out DATA")
