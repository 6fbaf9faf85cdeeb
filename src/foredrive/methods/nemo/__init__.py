"""NeMo (Huang, Zhang, Ohn-Bar, ECCV 2024): a volumetric world model."""

from foredrive.methods.nemo.motion import MotionConfig, MotionFlow
from foredrive.methods.nemo.rendering import RendererConfig, VolumeRenderer
from foredrive.methods.nemo.world_model import Nemo, NemoConfig

__all__ = ["MotionConfig", "MotionFlow", "Nemo", "NemoConfig", "RendererConfig", "VolumeRenderer"]
