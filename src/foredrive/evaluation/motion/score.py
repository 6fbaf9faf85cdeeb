"""Forecast agents scored under every protocol."""

from foredrive.evaluation.motion.files import AgentFiles
from foredrive.evaluation.summary import Figures
from foredrive.metrics.motion.moving import score_moving
from foredrive.metrics.motion.protocols import PROTOCOLS, Rectangle
from foredrive.metrics.motion.scores import motion_figures, score_motion


def score_agent_files(files: AgentFiles) -> Figures:
    """Return `motion.uniad.car.min_ade_m`, … and, of moving vehicles alone, `motion.moving.car.map_f`, …

    A protocol that the files do not tell enough for has no figures.
    """
    figures: Figures = {"motion.frames_counted": files.frames}
    figures["frames_without_results"] = files.frames_without_results
    for name, protocol in PROTOCOLS.items():
        if isinstance(protocol.region, Rectangle) and not files.heading_known:
            continue
        scores = score_motion(files.predicted, files.true, protocol)
        figures |= {f"motion.{name}.{key}": value for key, value in motion_figures(scores).items()}
    if files.futures_placed:
        for name, moving in score_moving(files.predicted, files.true).items():
            figures |= {f"motion.moving.{name}.{key}": value for key, value in vars(moving).items()}
    return figures
