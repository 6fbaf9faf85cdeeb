"""All cameras of a log at some of its frames: images and camera rig."""

from collections.abc import Collection, Sequence

import torch
from jaxtyping import Bool, UInt8
from py123d.datatypes import PinholeCameraMetadata
from torch import Tensor

from foredrive.data.image_store import ImageStore
from foredrive.data.logs import Log
from foredrive.scene import CameraRig


def read_rig(
    log: Log,
    frames: Sequence[int],
    cameras: Sequence[PinholeCameraMetadata | None],
    names: tuple[str, ...],
    store: ImageStore,
    with_images: Collection[int],
) -> tuple[UInt8[Tensor, "T C 3 H W"], Bool[Tensor, "T C"], CameraRig]:
    """Read images, their validity, and the rig. A camera that the log lacks has identity matrices.

    Args:
        log: the log to read.
        frames: T frames of the log.
        cameras: C cameras of the log; None for a missing one.
        names: C camera names.
        store: reader of the images; it sets their size.
        with_images: the frames whose images are read.

    Raises:
        InputError: an image or a pose cannot be read.
    """
    shape = (len(frames), len(names))
    images = torch.zeros(*shape, 3, *store.image_hw, dtype=torch.uint8)
    image_valid = torch.zeros(shape, dtype=torch.bool)
    K = torch.eye(3).repeat(*shape, 1, 1)
    T_ego_cam = torch.eye(4).repeat(*shape, 1, 1)
    dist = torch.zeros(*shape, 5)
    readout_s, exposed_dt_s = torch.zeros(shape), torch.zeros(shape)
    for c, metadata in enumerate(cameras):
        if metadata is None:
            continue
        for t, frame in enumerate(frames):
            camera = store.camera(log, frame, metadata, frame in with_images)
            K[t, c], T_ego_cam[t, c], dist[t, c] = camera.K, camera.T_ego_cam, camera.dist
            readout_s[t, c], exposed_dt_s[t, c] = camera.readout_s, camera.exposed_dt_s
            if camera.image is not None:
                images[t, c], image_valid[t, c] = camera.image, True
    rig = CameraRig(
        K=K,
        T_ego_cam=T_ego_cam,
        dist=dist,
        readout_s=readout_s,
        names=names,
        size_hw=store.image_hw,
        exposed_dt_s=exposed_dt_s,
    )
    return images, image_valid, rig
