"""Files of detections: read, scored as random finite sets and by the usual metrics, compared."""

from foredrive.evaluation.detections.files import read_detections
from foredrive.evaluation.detections.frame_file import write_frame_scores
from foredrive.evaluation.detections.frames import DetectionFrame, DetectionSet
from foredrive.evaluation.detections.score import FrameScore, predicted_set, score_frames
from foredrive.evaluation.detections.summary import ScoreSummary, compare_scores, summarise_scores

__all__ = [
    "DetectionFrame",
    "DetectionSet",
    "FrameScore",
    "ScoreSummary",
    "compare_scores",
    "predicted_set",
    "read_detections",
    "score_frames",
    "summarise_scores",
    "write_frame_scores",
]
