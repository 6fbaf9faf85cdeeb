"""NeMo (Huang, Zhang, Ohn-Bar, ECCV 2024): a volumetric world model."""

from foredrive.models.nemo.motion import MotionConfig, MotionFlow
from foredrive.models.nemo.rendering import RendererConfig, VolumeRenderer
from foredrive.models.nemo.world_model import Nemo, NemoConfig

__all__ = ["MotionConfig", "MotionFlow", "Nemo", "NemoConfig", "RendererConfig", "VolumeRenderer"]
