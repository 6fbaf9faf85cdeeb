"""Makes docs/drive.webp, the film of a drive by sight in the README: `python docs/draw_drive.py`."""

import tempfile
from pathlib import Path

from foredrive.data import LogPath
from foredrive.runs.drive.agent_inputs import rig_of
from foredrive.runs.drive.in_towns import TownRoutes
from foredrive.runs.drive.suite import DriveSuite, drive_suite
from foredrive.runs.shipped import run_folder
from foredrive.view.drive_video import write_drive_video

ROUTE = "12"


def main() -> None:
    """Drive the route and write its film."""
    with tempfile.TemporaryDirectory() as folder:
        agent = str(run_folder(Path("embedded"), Path(folder)).absolute())
        source = TownRoutes("town05-short", only=(ROUTE,), rig=rig_of(agent))
        (drive,) = drive_suite(DriveSuite(agent, source, lidar=False), Path(folder) / "drive").drives.values()
        log = LogPath(Path(folder) / "drive" / drive.log, Path(folder) / "drive" / "maps")
        write_drive_video(Path(__file__).parent / "drive.webp", log, drive)


if __name__ == "__main__":
    main()
