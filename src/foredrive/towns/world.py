"""A town for rendering: all static objects and the simulation of the recording vehicle's sensors."""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float32, Float64, Int, Int32, UInt8

from foredrive.data.modalities import FullOccupancy
from foredrive.scene import LidarSweep, VoxelSpec
from foredrive.scene.actors import ActorState
from foredrive.scene.conditions import Conditions, draw_daylight
from foredrive.scene.traffic_light import LightState
from foredrive.towns.labels.occupancy import full_occupancy
from foredrive.towns.labels.semantics import NO_ACTOR, SKY
from foredrive.towns.labels.visibility import visibility
from foredrive.towns.map.ground_plan import make_ground_plan
from foredrive.towns.map.town_map import TownMap
from foredrive.towns.place.actor_materials import MeshMaterials
from foredrive.towns.place.assets import Assets, AssetSet, asset_set_of, assets_of
from foredrive.towns.place.buildings import build_buildings
from foredrive.towns.place.fields import build_on_fields, lay_out_fields
from foredrive.towns.place.materials import (
    Material,
    MaterialArrays,
    MaterialTable,
    Surface,
    Texture,
    srgb_to_linear,
)
from foredrive.towns.place.mesh import Mesh, join
from foredrive.towns.place.parking import build_car_parks, park_on_strips, with_track_ids
from foredrive.towns.place.props import (
    SignalHead,
    StreetLamps,
    ThinPoints,
    build_posts,
    build_street_lamps,
    join_thin_points,
)
from foredrive.towns.place.road_mesh import build_roads
from foredrive.towns.place.site import Site
from foredrive.towns.place.street_furniture import build_street_furniture
from foredrive.towns.place.styles import style_of
from foredrive.towns.place.terrain import build_terrain, make_terrain
from foredrive.towns.place.vegetation import build_vegetation
from foredrive.towns.sensing import capture, lens, raycast, shading
from foredrive.towns.sensing.actor_shapes import SLOTS, ShapeLibrary, make_shape_library, unit_to_world
from foredrive.towns.sensing.capture import SensorSuite
from foredrive.towns.sensing.columns import make_columns
from foredrive.towns.sensing.hit_buffer import HitBuffer, empty_hit_buffer, surface_ids, track_ids
from foredrive.towns.sensing.lamps import gather_lamps
from foredrive.towns.sensing.light import Rgb, headlights_on, make_light, street_lamps_on

ACTOR_REACH_M = 200.0
"""Distance from the vehicle beyond which road users are not rendered, m."""
ACTOR_RADIUS_M = 8.0
LAMP_ORDER = (LightState.RED, LightState.YELLOW, LightState.GREEN)
LAMP_LIT = srgb_to_linear(((1.0, 0.10, 0.06), (1.0, 0.62, 0.05), (0.10, 1.0, 0.45)))
HEADLIGHT_LIT, TAIL_LIT, BRAKE_LIT, STREET_LAMP_LIT = srgb_to_linear(
    ((1.0, 0.98, 0.95), (0.42, 0.02, 0.01), (1.0, 0.10, 0.07), (1.0, 0.93, 0.80))
)
"""Linear colours of lights that are on."""


@dataclass(frozen=True)
class SensorFrame:
    """The sensor data at one time. Ids are track ids, `NO_ACTOR` where there is no road user."""

    images: dict[str, UInt8[np.ndarray, "H W 3"]]
    pixel_ids: dict[str, Int[np.ndarray, "H W"]]
    """Track id at the centre of each pixel. All other pixel labels also refer to the centre."""
    pixel_surface: dict[str, Int[np.ndarray, "H W"]]
    """`Surface`, -1 for the sky."""
    pixel_range_m: dict[str, Float32[np.ndarray, "H W"]]
    """Distance along the pixel's ray, m; infinite for the sky."""
    sweep: LidarSweep | None
    """Lidar sweep, unbatched, in the ego frame at the frame's time; None without a lidar. A beam without a
    return is free up to the surface that it hit."""
    beam_ids: Int[np.ndarray, "N"]
    """Track ids of all beams, including those without a return."""
    beam_surface: Int[np.ndarray, "N"]
    """`Surface` of all beams, -1 where a beam hit nothing."""


@dataclass(frozen=True)
class VehicleLights:
    """Materials of vehicle lights: while driving, while braking, and on parked vehicles."""

    front: int
    rear: int
    brake: int
    front_off: int
    rear_off: int

    @classmethod
    def of(cls, table: MaterialTable) -> "VehicleLights":
        """Return the materials of the shapes' lights, and add one more material for each state."""
        front = MeshMaterials(table).front_light
        rear = table.add(Material(Surface.VEHICLE, Texture.PLAIN, (0.55, 0.03, 0.03), 0.9, 0.08))
        brake = table.add(replace(table.materials[rear], params=(0.0, 2.0)))
        off = [table.add(replace(table.materials[material], params=(0.0, 1.0))) for material in (front, rear)]
        return cls(front, rear, brake, *off)


@dataclass(frozen=True)
class StaticWorld:
    """The static content of a town."""

    mesh: Mesh
    track: Int32[np.ndarray, "F"]
    """Track id of the parked car to which a triangle belongs, `NO_ACTOR` for all others."""
    parked: tuple[ActorState, ...]
    heads: tuple[SignalHead, ...]
    thin: ThinPoints
    lamps: StreetLamps
    vehicle_lights: VehicleLights


class World:
    """A town generated from a seed. The same map, seed and conditions give the same world.

    The conditions change only the light and the air; None draws bright daylight from the seed. By default the
    assets are those of the town's split, so a held-out town has materials and shapes that never occur in
    training.
    """

    def __init__(
        self,
        town: TownMap,
        seed: int,
        conditions: Conditions | None = None,
        assets: AssetSet | None = None,
    ) -> None:
        # Independent random numbers for place and weather: other conditions do not change the place
        rng, weather_rng = np.random.default_rng([seed, *town.name.encode()]).spawn(2)
        table = MaterialTable()
        chosen = assets_of(assets or asset_set_of(town.name))
        self.town = town
        self.conditions = conditions or draw_daylight(weather_rng)
        self._east_rad = float(weather_rng.uniform(0.0, 2.0 * np.pi))
        self.light = make_light(self.conditions, self._east_rad)
        self._lens_seed = int(weather_rng.integers(1 << 30))
        self._shapes = make_shape_library(table, chosen)
        self.static = build_static(town, table, self._shapes, chosen, rng)
        # The table is complete only when everything is built
        self._materials = table.arrays()
        self._scene = raycast.TriangleScene(self.static.mesh)
        static = self.static
        self._columns = make_columns(static.mesh, self._scene, self._materials.surface, static.thin)

    def under(self, conditions: Conditions) -> "World":
        """Return the same town under other conditions.

        It shares the static content, which is not generated again.
        """
        other = copy(self)
        other.conditions, other.light = conditions, make_light(conditions, self._east_rad)
        return other

    @property
    def parked(self) -> tuple[ActorState, ...]:
        """Return the parked cars.

        They are a part of the world that `render` and `occupancy` already include.
        """
        return self.static.parked

    @property
    def surfaces(self) -> Int[np.ndarray, "L"]:
        """Return the `Surface` of each material in the static mesh."""
        return self._materials.surface

    def render(
        self,
        actors: Sequence[ActorState],
        sensors: SensorSuite,
        T_world_ego: Float64[np.ndarray, "4 4"],
        twist_ego: Float[np.ndarray, "6"],
        noise_seed: int,
        lights: Int[np.ndarray, "Z"] | None = None,
    ) -> SensorFrame:
        """Render the sensor data at one time.

        The vehicle and the road users move straight ahead during a sweep and during the exposure of an image.

        Args:
            actors: road users without the ego vehicle. Parked ones are ignored, because the world contains
                them.
            sensors: the sensors.
            T_world_ego: pose of the vehicle.
            twist_ego: velocity (m/s), then turn rate (rad/s), of the ego frame in its own axes.
            noise_seed: seed of range noise, of lost beams and of image noise.
            lights: a `LightState` for each of the town's stop zones. None: all lamps are off.
        """
        # Parked cars are part of the static mesh
        near = [a for a in actors if not a.parked and _distance(a, T_world_ego) < ACTOR_REACH_M]
        tracer = self._ray_tracer(near, lights, T_world_ego)
        # Independent noise for images, lidar and rain
        ego = capture.EgoMotion(T_world_ego, twist_ego)
        images, buffer = capture.render_images(tracer, sensors, ego, np.random.default_rng((noise_seed, 1)))
        images = self._through_air_and_lens(images, sensors, noise_seed)
        sweep, met = None, empty_hit_buffer(0)
        if sensors.lidar is not None:
            noise = np.random.default_rng(noise_seed)
            sweep, met = capture.simulate_sweep(tracer, sensors.lidar, ego, noise)
        names = sensors.rig.names
        shape = (len(names), *sensors.rig.size_hw)
        return SensorFrame(
            images=dict(zip(names, images, strict=True)),
            pixel_ids=dict(zip(names, self._track_ids(buffer, near).reshape(shape), strict=True)),
            pixel_surface=dict(zip(names, self._surfaces(buffer).reshape(shape), strict=True)),
            pixel_range_m=dict(zip(names, buffer.range_m.reshape(shape), strict=True)),
            sweep=sweep,
            beam_ids=self._track_ids(met, near),
            beam_surface=self._surfaces(met),
        )

    def occupancy(
        self, actors: Sequence[ActorState], T_world_ego: Float64[np.ndarray, "4 4"], spec: VoxelSpec
    ) -> FullOccupancy:
        """Compute the exact occupancy of a grid in the ego frame, including the inside of solid objects.

        `category` is that of the road user, or -1 minus the `Surface` of static matter. Velocities are those
        of the road users in the ego axes. A call takes 0.2 s at a new place, and milliseconds at a known one.

        Raises:
            InputError: the voxels are finer than `occupancy.FINEST_VOXEL_M`.
        """
        # Road users whose body may reach into the grid
        reach_m = float(np.linalg.norm([*spec.lower_m, *spec.upper_m]))
        moving = [actor for actor in actors if not actor.parked]
        near = [a for a in (*moving, *self.parked) if _distance(a, T_world_ego) < reach_m + ACTOR_RADIUS_M]
        shaped = [(actor, self._shapes.shape_of(actor)) for actor in near]
        return full_occupancy(self._columns, shaped, T_world_ego, spec)

    def visibility(
        self,
        actors: Sequence[ActorState],
        sensors: SensorSuite,
        T_world_ego: Float64[np.ndarray, "4 4"],
        frame: SensorFrame,
    ) -> Float32[np.ndarray, "M"]:
        """Return the visible share of each road user, parked cars included, in a frame (see
        `labels.visibility`)."""
        shaped = [(actor, self._shapes.shape_of(actor)) for actor in actors]
        return visibility(shaped, sensors, T_world_ego, np.stack(list(frame.pixel_ids.values())))

    def struck(
        self, origin: Float32[np.ndarray, "N 3"], direction: Float32[np.ndarray, "N 3"]
    ) -> tuple[Float32[np.ndarray, "N"], Int[np.ndarray, "N"]]:
        """Cast rays at the static world, parked cars included.

        Returns:
            The distance, in lengths of `direction`, and the `Surface`; infinite and -1 if a ray hits nothing.
        """
        # Rays need no unit length: distances are multiples of the direction
        hits = self._scene.cast(origin, direction)
        met = hits.triangle != shading.MISS
        surface = self._materials.surface[self.static.mesh.material[np.where(met, hits.triangle, 0)]]
        return np.where(met, hits.t, np.float32(np.inf)), np.where(met, surface, SKY)

    @cached_property
    def signal_xyz(self) -> dict[int, Float64[np.ndarray, "_ 3"]]:
        """Return points on the lamps of each traffic light, by the index of its stop zone."""
        material, xyz = self.static.mesh.material, self.static.mesh.xyz
        points = {}
        for head in self.static.heads:
            # Middles of the yellow lamps' faces; one point per head
            middle = xyz[material == head.lamps[1]].mean(axis=1, dtype=np.float64)
            _, first = np.unique(np.round(middle), axis=0, return_index=True)  # over the road and on the post
            points[head.zone] = middle[first]
        return points

    def _ray_tracer(
        self,
        actors: list[ActorState],
        lights: Int[np.ndarray, "Z"] | None,
        T_world_ego: Float64[np.ndarray, "4 4"],
    ) -> capture.RayTracer:
        # Each actor is an instance of its shape, moved and scaled from the unit box
        shapes = [self._shapes.shape_of(actor) for actor in actors]
        T = np.array([unit_to_world(actor) for actor in actors]).reshape(-1, 4, 4)
        velocity_mps = np.array([actor.velocity_mps for actor in actors]).reshape(-1, 3)
        placed = raycast.ShapeInstances(tuple(shape.scene for shape in shapes), T, velocity_mps)
        rear = self.static.vehicle_lights
        # The last paint slot is the rear light: braking or not
        paints = [self._shapes.paint_of(a, rear.brake if a.braking else rear.rear) for a in actors]
        paint = np.array(paints, dtype=np.int32).reshape(-1, SLOTS)
        first = np.array([shape.first for shape in shapes], dtype=np.int32)
        scene = shading.SceneArrays(
            static=_triangles(self.static.mesh),
            shapes=_triangles(self._shapes.triangles),
            actors=shading.ActorArrays(placed.T_world_unit, first, paint),
            materials=self._lit_materials(lights),
        )
        # Lamps only at night: by day they add nothing visible
        light = self.light
        if street_lamps_on(self.conditions):
            light = light._replace(lamps=gather_lamps(self.static.lamps.xyz, actors, T_world_ego))
        return capture.RayTracer(scene, raycast.RaycastScene(self._scene, placed), light)

    def _through_air_and_lens(
        self, images: UInt8[np.ndarray, "C H W 3"], sensors: SensorSuite, noise_seed: int
    ) -> UInt8[np.ndarray, "C H W 3"]:
        """Add glare by night, and rain, to images."""
        if street_lamps_on(self.conditions):
            images = np.stack([lens.add_glare(image) for image in images])
        if self.conditions.rain_mmph == 0.0:
            return images
        rng = np.random.default_rng((noise_seed, 2))
        rgb = shading.develop(self.light.haze_rgb[None], self.light.exposure, 1)[0]
        focal_px = sensors.rig.K[:, 0, 0].tolist()
        drops = [
            lens.add_rain(image, self.conditions, focal, rgb, self._lens_seed + camera, rng)
            for camera, (image, focal) in enumerate(zip(images, focal_px, strict=True))
        ]
        return np.stack(drops)

    def _lit_materials(self, lights: Int[np.ndarray, "Z"] | None) -> MaterialArrays:
        # Materials that shine in this state of lights
        """Return the materials with the lights that are on."""
        shining: dict[int, Rgb] = {self.static.vehicle_lights.brake: BRAKE_LIT}
        if headlights_on(self.conditions):
            shining |= {
                self.static.vehicle_lights.front: HEADLIGHT_LIT,
                self.static.vehicle_lights.rear: TAIL_LIT,
            }
        if street_lamps_on(self.conditions):
            shining[self.static.lamps.material] = STREET_LAMP_LIT
        if lights is not None:
            for head in self.static.heads:
                for lamp, shown, rgb in zip(head.lamps, LAMP_ORDER, LAMP_LIT, strict=True):
                    if lights[head.zone] == shown:
                        shining[lamp] = rgb
        # Shining materials become luminous: the texture emits the albedo as light
        texture, albedo = self._materials.texture.copy(), self._materials.albedo.copy()
        texture[list(shining)] = Texture.GLOW
        albedo[list(shining)] = np.array(list(shining.values()))
        return self._materials._replace(texture=texture, albedo=albedo)

    def _surfaces(self, buffer: HitBuffer) -> Int[np.ndarray, "N"]:
        return surface_ids(buffer, self._materials.surface, SKY)

    def _track_ids(self, buffer: HitBuffer, actors: list[ActorState]) -> Int[np.ndarray, "N"]:
        of_actor = np.array([actor.track_id for actor in actors], dtype=np.int64)
        return track_ids(buffer, of_actor, self.static.track, NO_ACTOR)


def build_static(
    town: TownMap, table: MaterialTable, shapes: ShapeLibrary, assets: Assets, rng: np.random.Generator
) -> StaticWorld:
    """Generate the static content of a town.

    Objects of the map come first, then the objects that need most space.
    """
    plan = make_ground_plan(town)
    terrain = make_terrain(plan, town.bounds_m, rng)
    site = Site(plan, terrain)
    posts = build_posts(town, site, table)
    lots, cars = build_car_parks(site, table, rng)
    parked = with_track_ids(park_on_strips(town, site, rng) + cars)
    place = join(
        [
            build_roads(town, plan, table),
            posts.mesh,
            lots,
            build_buildings(site, town.name, assets, table, rng),
        ]
    )
    furniture, details = build_street_furniture(town, site, table, rng)
    lamps = build_street_lamps(site, table, rng)
    fields = lay_out_fields(site, table, rng) if style_of(town.name).farmland else ()
    land = build_terrain(terrain, plan, table, fields)
    farm, fences = build_on_fields(fields, site, table, rng)
    plants, trunks = build_vegetation(site, assets, table, rng)
    place = join([place, furniture, lamps.mesh, land, farm, plants])
    vehicle_lights = VehicleLights.of(table)
    # Parked cars become part of the static mesh, with their track ids by triangle
    vehicles = [_standing(car, shapes, vehicle_lights) for car in parked]
    track = [np.full(len(place.material), NO_ACTOR, dtype=np.int32)]
    track += [
        np.full(len(v.material), c.track_id, dtype=np.int32) for v, c in zip(vehicles, parked, strict=True)
    ]
    return StaticWorld(
        mesh=join([place, *vehicles]),
        track=np.concatenate(track),
        parked=parked,
        heads=posts.heads,
        thin=join_thin_points([posts.thin, details, lamps.thin, fences, trunks]),
        lamps=lamps.lamps,
        vehicle_lights=vehicle_lights,
    )


def _standing(car: ActorState, shapes: ShapeLibrary, lights: VehicleLights) -> Mesh:
    """Build the mesh of a parked car as a part of the town, with its lights off."""
    shape, paint = shapes.shape_of(car).mesh, shapes.paint_of(car, lights.rear_off)
    moved = shape.transformed(unit_to_world(car))
    # Paint slots have negative numbers
    slot = np.clip(-1 - moved.material, 0, SLOTS - 1)
    material = np.where(moved.material < 0, paint[slot], moved.material)
    material = np.where(material == lights.front, lights.front_off, material)
    return Mesh(moved.xyz, moved.uvw, material.astype(np.int32))


def _triangles(mesh: Mesh) -> shading.Triangles:
    return shading.Triangles(mesh.xyz, mesh.uvw, mesh.material)


def _distance(actor: ActorState, T_world_ego: Float64[np.ndarray, "4 4"]) -> float:
    return float(np.linalg.norm(actor.centre_m - T_world_ego[:3, 3]))
