"""Neural fields of driving scenes (Tonderski et al., "NeuRAD", CVPR 2024)."""

from foredrive.methods.neurad.config import FieldConfig, GridConfig
from foredrive.methods.neurad.rays import FieldRays, beam_rays, pixel_rays
from foredrive.methods.neurad.render import FieldActors, NeuralField, SeenAlongRays

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
