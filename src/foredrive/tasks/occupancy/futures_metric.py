"""Sampled futures: the best of K, the mean of all, and their spread."""

from foredrive.scene import Example
from foredrive.tasks.metric import EvaluationContext, Figures, Shown, labels_from_now
from foredrive.tasks.occupancy.forecasts import FuturesCounts, count_futures
from foredrive.tasks.occupancy.scores import above_ground
from foredrive.tasks.predictor import Part, Prediction


class FuturesMetric:
    """IoU of K sampled futures, over all voxels and over those above the ground.

    Keys: `iou_future_1s.best_of_5`, `iou_future_1s.mean_of_5`, `spread_future_1s`.
    """

    name = "occupancy"
    title = "Occupancy"
    shown: tuple[Shown, ...] = ()
    needs: frozenset[Part] = frozenset({"futures"})

    def __init__(self, context: EvaluationContext) -> None:
        self._context = context
        self._drawn = 0
        self._counts: dict[str, FuturesCounts] = {}

    def update(self, prediction: Prediction, truth: Example) -> None:
        """Count hits and misses of b clips.

        Raises:
            InputError: if the clips end before the futures.
        """
        assert prediction.futures is not None
        self._drawn, frames = prediction.futures.shape[1:3]
        # The futures begin after now
        labels = labels_from_now(truth.occupancy, truth.clip, frames + 1)[:, 1:]
        for scope, region in {"": None, "above_ground.": above_ground(labels.spec)}.items():
            counts = count_futures(prediction.futures, labels, region)
            self._counts[scope] = self._counts[scope] + counts if scope in self._counts else counts

    def result(self) -> Figures:
        """Return the ratios of the sums, and the mean spread."""
        out: Figures = {}
        for scope, counts in self._counts.items():
            spread = counts.spread / counts.items
            names = self._context.frame_names(len(spread) + 1)[1:]
            columns = (counts.best.iou.tolist(), counts.mean.iou.tolist(), spread.tolist())
            for name, best, mean, apart in zip(names, *columns, strict=True):
                key = f"{scope}iou_{name}"
                out |= {f"{key}.best_of_{self._drawn}": best, f"{key}.mean_of_{self._drawn}": mean}
                out[f"{scope}spread_{name}"] = apart
        return out
