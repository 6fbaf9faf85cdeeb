"""Effects of rain and darkness in front of the lens and on it: streaks, drops, and glare around bright
areas."""

from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from foredrive.scene.conditions import Conditions

FALL_MPS = 7.0
"""Speed of falling drops of 2 mm, m/s (Gunn & Kinzer, J. Meteorology 6, 1949)."""
EXPOSURE_S = 1 / 60
DROP_M = 2e-3
STREAKS_PER_PIXEL = 1.1e-3
"""Streaks per pixel at 10 mm/h, from drops that are close enough to be visible one by one."""
MIN_STREAK_M, MAX_STREAK_M = 0.8, 7.0
LENS_DROPS = 9
DROP_RADIUS = (0.006, 0.024)
"""Minimum and maximum radius of drops on the lens, as a fraction of the image width."""
GLARE_LEVEL, GLARE_SHARE, GLARE_WIDTH = 200, 0.55, 0.012

Image = UInt8[np.ndarray, "H W 3"]


def add_glare(image: Image) -> Image:
    """Spread the light of the brightest areas, as lenses do at night."""
    # Only what exceeds the level is blurred and added
    bright = np.maximum(image, GLARE_LEVEL) - np.uint8(GLARE_LEVEL)
    spilt = cv2.GaussianBlur(bright, (0, 0), GLARE_WIDTH * image.shape[1])
    return np.asarray(cv2.addWeighted(image, 1.0, spilt, GLARE_SHARE * 255 / (255 - GLARE_LEVEL), 0.0))


def add_rain(
    image: Image,
    conditions: Conditions,
    focal_px: float,
    rgb: UInt8[np.ndarray, "3"],
    lens_seed: int,
    rng: np.random.Generator,
) -> Image:
    """Add streaks of falling drops, which have the colour of the sky, then drops on the lens.

    Args:
        rgb: colour of the sky, which a drop refracts to the camera.
        lens_seed: seed of the drops on the lens.
        rng: random numbers of the falling drops.
    """
    share = _streaks(image.shape[:2], conditions.rain_mmph, focal_px, rng)[..., None]
    falling = (image + share * (rgb - image.astype(np.float32))).astype(np.uint8)
    map_x, map_y, on_drop = _lens_drops(image.shape[:2], lens_seed)
    through = cv2.remap(
        cv2.blur(falling, (3, 3)), map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
    )
    return (falling + on_drop * (through - falling.astype(np.float32))).astype(np.uint8)


def _streaks(
    size_hw: tuple[int, int], rain_mmph: float, focal_px: float, rng: np.random.Generator
) -> Float32[np.ndarray, "H W"]:
    """Return the share of each pixel that falling drops hide. The number of drops grows with R^0.63."""
    height, width = size_hw
    # Drops per volume grow with R^0.63; streaks are drawn as a share of the pixel that they hide
    count = round(STREAKS_PER_PIXEL * height * width * (rain_mmph / 10.0) ** 0.63)
    distance_m = rng.uniform(MIN_STREAK_M, MAX_STREAK_M, count)
    start = rng.random((count, 2)) * (width, 1.3 * height) - (0.0, 0.3 * height)
    slant = rng.normal(0.05, 0.03, count)
    # Length by the way that the drop falls during the exposure, at its distance
    length_px = focal_px * FALL_MPS * EXPOSURE_S / distance_m
    ends = start + length_px[:, None] * np.column_stack([slant, np.ones(count)])
    wide_px = DROP_M * focal_px / distance_m
    out = np.zeros(size_hw, np.float32)
    lines = np.stack([start, ends], axis=1)
    # Widths below a pixel become opacity: lines are drawn in groups of similar width
    for low, high in ((0.0, 0.15), (0.15, 0.4), (0.4, np.inf)):
        some = (wide_px >= low) & (wide_px < high)
        if some.any():
            layer = np.zeros(size_hw, np.uint8)
            # OpenCV's fixed-point coordinates with 4 fractional bits
            points = np.round(lines[some] * 16).astype(np.int32)
            cv2.polylines(layer, list(points), False, 255, 1, cv2.LINE_AA, 4)
            out += layer * np.float32(min(0.5, wide_px[some].mean()) / 255)
    return out.clip(0.0, 0.6)


@lru_cache(maxsize=16)
def _lens_drops(
    size_hw: tuple[int, int], seed: int
) -> tuple[Float32[np.ndarray, "H W"], Float32[np.ndarray, "H W"], Float32[np.ndarray, "H W 1"]]:
    """Return the source positions of light through drops, which show the scene upside down, and the drops'
    share."""
    rng = np.random.default_rng(seed)
    height, width = size_hw
    y, x = np.mgrid[:height, :width].astype(np.float32)
    map_x, map_y, share = x.copy(), y.copy(), np.zeros(size_hw, np.float32)
    for _ in range(int(rng.integers(LENS_DROPS // 2, LENS_DROPS + 1))):
        centre_x, centre_y = rng.uniform(0.0, width), rng.uniform(0.0, height)
        radius = width * rng.uniform(*DROP_RADIUS)
        # A drop acts as a lens: it shows the scene upside down, over a wide angle
        dx, dy = x - np.float32(centre_x), (y - np.float32(centre_y)) * np.float32(rng.uniform(0.75, 1.0))
        near = (dx * dx + dy * dy) / np.float32(radius * radius)
        inside = near < 1.0
        map_x[inside], map_y[inside] = (x - 3.0 * dx)[inside], (y - 4.0 * dy)[inside]
        share = np.maximum(share, np.clip(2.5 * (1.0 - near), 0.0, 0.8))
    return map_x, map_y, share[..., None]
