"""Write videos."""

import itertools
from collections.abc import Iterable, Iterator
from fractions import Fraction
from importlib import util
from pathlib import Path

import numpy as np
from PIL import Image

from foredrive.errors import InputError
from foredrive.files import atomic_path

WEBP_QUALITY = 55
MP4, WEBP = ".mp4", ".webp"


def check_video(path: Path) -> None:
    """Check that a video can be written under this name.

    Raises:
        InputError: the name ends in neither .mp4 nor .webp, or PyAV is missing for MP4.
    """
    if path.suffix not in (MP4, WEBP):
        raise InputError(f"{path}: videos end on {MP4}, or on {WEBP}, which browsers play as a picture")
    if path.suffix == MP4 and util.find_spec("av") is None:
        raise InputError(f"{path}: MP4 needs PyAV: pip install 'foredrive[video]', or write {WEBP}")


def write_video(path: Path, frames: Iterable[Image.Image], frame_s: float) -> None:
    """Write frames of one size, each shown for `frame_s`: MP4 (H.264) or animated WebP, by the path's suffix.

    Args:
        frames: at least one. MP4 keeps no frames in memory, WebP keeps all.

    Raises:
        InputError: as `check_video`.
    """
    check_video(path)
    with atomic_path(path) as temporary:
        if path.suffix == MP4:
            _write_mp4(temporary, iter(frames), frame_s)
            return
        first, *others = frames
        first.save(
            temporary,
            format="WEBP",
            save_all=True,
            append_images=others,
            duration=round(1000 * frame_s),
            loop=0,
            quality=WEBP_QUALITY,
        )


def _write_mp4(path: Path, frames: Iterator[Image.Image], frame_s: float) -> None:
    import av  # An optional package

    first = next(frames)
    width, height = (n - n % 2 for n in first.size)  # H.264 needs even sizes
    with av.open(str(path), "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=Fraction(1 / frame_s).limit_denominator(1000))
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for frame in itertools.chain([first], frames):
            picture = av.VideoFrame.from_ndarray(np.asarray(frame)[:height, :width].copy(), format="rgb24")
            container.mux(stream.encode(picture))
        # Flush the frames that the encoder has delayed
        container.mux(stream.encode())
