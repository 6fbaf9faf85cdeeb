"""`foredrive record`."""

from pathlib import Path
from typing import Annotated

import tyro


def record(
    town: str,
    out: Path,
    seconds: float = 20.0,
    seed: int = 0,
    rate: Annotated[float, tyro.conf.arg(metavar="HZ")] = 10.0,
    image_size: Annotated[tuple[int, int], tyro.conf.arg(metavar="HEIGHT WIDTH")] = (144, 256),
    vehicles: int = 30,
    people: int = 20,
) -> None:
    """Record a drive through a town as a 123D log with exact labels.

    Args:
        town: Town01 to Town07 or Town10HD; Town05 is held out for testing.
        out: 123D data root; the log and the town's map are written into it.
        seconds: Length of the drive, s.
        seed: Decides the buildings, the route, the traffic and all noise; the same seed gives the same bytes.
        rate: Frames per second.
        image_size: Size of the six cameras' images, px.
        vehicles: How many vehicles share the road near the ego vehicle.
        people: How many pedestrians do, where the town has walkways.
    """
    from foredrive.towns.recorder import Crowd
    from foredrive.towns.recorder import record as record_drive
    from foredrive.towns.sensing.capture import SensorSuite
    from foredrive.towns.sensing.rig import camera_rig, roof_lidar

    sensors = SensorSuite(camera_rig(image_size), roof_lidar())
    log = record_drive(town, seconds, seed, out, rate, sensors, Crowd(vehicles, people))
    print(f"wrote {log.folder}")
    print(f"look: foredrive view {log.folder} --save {log.folder.name}.png")
