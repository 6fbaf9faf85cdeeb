"""The part of a camera's image that an image tower looks at."""

from enum import StrEnum


class Crop(StrEnum):
    """Crops of an image. The sweep of a view is cut to the same part, so that both show the same scene."""

    WHOLE = "whole"
    MIDDLE_SQUARE = "middle-square"
    """The largest square around the middle, as CLIP is trained (Radford et al. 2021)."""

    def box_px(self, size_hw: tuple[int, int]) -> tuple[int, int, int, int]:
        """Return left, top, right and bottom of the crop of an image of this size."""
        height, width = size_hw
        if self is Crop.WHOLE:
            return 0, 0, width, height
        side = min(height, width)
        left, top = (width - side) // 2, (height - side) // 2
        return left, top, left + side, top + side
