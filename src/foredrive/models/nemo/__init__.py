"""NeMo (Huang, Zhang, Ohn-Bar, ECCV 2024): a volumetric world model."""

from foredrive.models.nemo.motion import MotionFlow
from foredrive.models.nemo.rendering import VolumeRenderer
from foredrive.models.nemo.world_model import Nemo

__all__ = ["MotionFlow", "Nemo", "VolumeRenderer"]
