"""Neural fields of driving scenes (Tonderski et al., "NeuRAD", CVPR 2024)."""

from foredrive.rendering.field.config import FieldConfig, GridConfig
from foredrive.rendering.field.rays import FieldRays, beam_rays, pixel_rays
from foredrive.rendering.field.render import FieldActors, NeuralField, SeenAlongRays

__all__ = [
    "FieldActors",
    "FieldConfig",
    "FieldRays",
    "GridConfig",
    "NeuralField",
    "SeenAlongRays",
    "beam_rays",
    "pixel_rays",
]
