"""Materials that all road users share, and placeholders for the paint of each one."""

from dataclasses import dataclass

from foredrive.towns.place.materials import RETROREFLECTIVE, Material, MaterialTable, Surface, Texture

BODY, SECOND, THIRD, REAR_LIGHT = -1, -2, -3, -4
"""Look numbers that are replaced by an actor's own paint and by the state of its rear lights."""


@dataclass
class MeshMaterials:
    """Numbers of the materials that are the same for all road users."""

    table: MaterialTable

    def __post_init__(self) -> None:
        def add(texture: Texture, rgb: tuple[float, float, float], reflectivity: float, gloss: float) -> int:
            return self.table.add(Material(Surface.VEHICLE, texture, rgb, reflectivity, gloss))

        self.glass = add(Texture.GLASS, (0.05, 0.06, 0.07), 0.1, 0.05)
        self.tyre = add(Texture.PLAIN, (0.07, 0.07, 0.07), 0.08, 0.0)
        self.hub = add(Texture.PLAIN, (0.55, 0.56, 0.57), 0.5, 0.1)
        self.dark = add(Texture.PLAIN, (0.12, 0.12, 0.13), 0.12, 0.0)
        self.front_light = add(Texture.PLAIN, (0.95, 0.95, 0.92), 0.9, 0.15)
        self.rear_light = REAR_LIGHT
        self.plate = add(Texture.PLAIN, (0.90, 0.90, 0.85), RETROREFLECTIVE, 0.0)
        self.orange = add(Texture.PLAIN, (0.95, 0.35, 0.08), 0.8, 0.0)
        self.hair = self.table.add(Material(Surface.PEDESTRIAN, Texture.PLAIN, (0.16, 0.11, 0.08), 0.2))
        self.helmet = self.table.add(Material(Surface.PEDESTRIAN, Texture.PLAIN, (0.12, 0.12, 0.13), 0.12))
        self.tank = add(Texture.PLAIN, (0.45, 0.06, 0.05), 0.3, 0.08)
