"""Light and weather: what they do to images and to lidar sweeps."""

import math

import numpy as np
import pytest
from scenes import STILL, actor_at, ego_pose
from scipy.integrate import quad

from foredrive.scene.actors import ActorState
from foredrive.scene.conditions import CONDITIONS, Conditions, find_conditions
from foredrive.sensors.rigs import camera_rig
from foredrive.sensors.vehicle import roof_lidar
from foredrive.towns.map.town_map import TownMap
from foredrive.towns.place.materials import Material, MaterialArrays, MaterialTable, Surface, Texture
from foredrive.towns.sensing import lens
from foredrive.towns.sensing.beams import MAX_LATERAL_M, add_beams, phase
from foredrive.towns.sensing.capture import NOT_KNOWN, SensorSuite
from foredrive.towns.sensing.lamps import UNIT_LUX, gather_lamps, lamp_light
from foredrive.towns.sensing.lidar_returns import air_returns, lidar_returns
from foredrive.towns.sensing.light import (
    BACKSCATTER_RATIO,
    daylight_lux,
    headlights_on,
    make_air,
    make_light,
    rain_extinction_per_m,
    street_lamps_on,
    sun_direction,
)
from foredrive.towns.sensing.shading import Surfaces, shade
from foredrive.towns.sensing.wet import water_mirror
from foredrive.towns.world import NO_ACTOR, SensorFrame, World

DOWN = np.array([0.0, 0.0, 1.0], np.float32)


def materials_of(*materials: Material) -> MaterialArrays:
    table = MaterialTable()
    for material in materials:
        table.add(material)
    return table.arrays()


WALL = materials_of(Material(Surface.BUILDING, Texture.PLAIN, (0.6, 0.6, 0.6), 0.4))
ROAD = materials_of(Material(Surface.ROAD, Texture.PLAIN, (0.35, 0.35, 0.35), 0.4))


def met(count: int, normal: np.ndarray, cosine: float = 1.0) -> Surfaces:
    return Surfaces(
        np.zeros(count, np.int32),
        np.random.default_rng(0).uniform(-100, 100, (count, 3)).astype(np.float32),
        np.tile(normal.astype(np.float32), (count, 1)),
        np.full(count, cosine, np.float32),
        np.zeros((count, 3), np.float32),
        np.full((count, 4), 0.01, np.float32),
    )


def returned_share(conditions: Conditions, range_m: float, materials: MaterialArrays = WALL) -> float:
    count = 20_000
    chance = np.random.default_rng(1).random((count, 2), dtype=np.float32)
    normal = DOWN if materials is ROAD else np.array([1.0, 0.0, 0.0])
    t = np.full(count, range_m, np.float32)
    air = make_air(conditions)
    _, returned, _ = lidar_returns(materials, met(count, normal), t, np.float32(200.0), chance, air)
    return float(returned.mean())


def test_a_matt_wall_at_60_degrees_looks_half_as_bright() -> None:
    chance, t, air = np.zeros((1, 2), np.float32), np.full(1, 5.0, np.float32), make_air(Conditions())
    normal, far_m = np.array([1.0, 0.0, 0.0]), np.float32(200.0)
    ahead, aside = (
        lidar_returns(WALL, met(1, normal, cosine), t, far_m, chance, air)[2].item() for cosine in (1.0, 0.5)
    )
    assert ahead == pytest.approx(0.4 * 100 / 255, rel=5e-3)  # the air dims it a little
    assert aside == pytest.approx(0.5 * ahead, rel=1e-6)


def seen_through(conditions: Conditions, range_m: float) -> np.ndarray:
    """Radiance of a wall in the shade."""
    light = make_light(conditions, 0.0)
    direction = np.array([[1.0, 0.0, 0.0]], np.float32)
    t, unlit = np.array([range_m], np.float32), np.zeros(1, np.bool_)
    found = met(1, np.array([-1.0, 0.0, 0.0]))
    return shade(WALL, found, t, direction, unlit, light, NOT_KNOWN, NOT_KNOWN)[0]


def test_the_sun_rises_and_sets() -> None:
    np.testing.assert_allclose(sun_direction(6.0, 0.0), [1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(sun_direction(12.0, 0.0), [0, -0.5, math.sqrt(0.75)], atol=1e-6)
    np.testing.assert_allclose(sun_direction(18.0, 0.0), [-1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(sun_direction(6.0, 0.5 * math.pi), [0, 1, 0], atol=1e-6)
    assert sun_direction(0.0, 0.0)[2] < -0.8


def test_low_sun_is_warm_and_weak() -> None:
    noon, late = (make_light(Conditions(hour=h, clouds=0.0), 0.0).sun_rgb for h in (12.0, 17.6))
    assert late[0] / late[2] > 2.0 * noon[0] / noon[2]
    assert (late < 0.5 * noon).all()


def test_fog_hides_by_koschmieders_law() -> None:
    fog = Conditions(clouds=0.9, visibility_m=200.0)
    near, middle, far = (seen_through(fog, d) for d in (0.0, 100.0, 200.0))
    haze = make_light(fog, 0.0).haze_rgb
    np.testing.assert_allclose((far - haze) / (near - haze), 0.02, atol=1e-3)
    np.testing.assert_allclose((middle - haze) / (near - haze), math.sqrt(0.02), atol=1e-3)


def test_lidar_echoes_fall_as_the_formula_says() -> None:
    assert make_air(Conditions(visibility_m=300.0)).lidar_extinction_per_m == pytest.approx(3.912 / 300.0)
    fog = Conditions(visibility_m=300.0)
    for range_m in (20.0, 60.0):
        echo = 0.4 * (45.0 / range_m) ** 2 * math.exp(-2 * 3.912 / 300.0 * range_m)
        assert returned_share(fog, range_m) == pytest.approx(echo / (echo + 0.02), abs=0.01)


def test_rain_takes_what_its_drops_hide() -> None:
    # twice the cross-section of Marshall and Palmer's drops, summed up over their sizes
    d_mm = np.linspace(0.0, 20.0, 200_001)
    per_m3 = 8000.0 * np.exp(-4.1 * 20.0**-0.21 * d_mm)
    expected = float(np.sum(0.5 * math.pi * (1e-3 * d_mm) ** 2 * per_m3) * (d_mm[1] - d_mm[0]))
    assert rain_extinction_per_m(20.0) == pytest.approx(expected, rel=0.02)


def test_more_rain_loses_more_beams() -> None:
    shares = [returned_share(Conditions(rain_mmph=r, wetness=0.5), 90.0) for r in (0.0, 5.0, 20.0, 80.0)]
    assert shares == sorted(shares, reverse=True)
    assert shares[0] - shares[-1] > 0.05


def test_wet_roads_send_less_back() -> None:
    dry, wet = (returned_share(Conditions(wetness=w), 80.0, ROAD) for w in (0.0, 0.9))
    assert wet < dry - 0.1


@pytest.mark.parametrize(
    ("conditions", "low", "high"),
    [
        (Conditions(), 0.0, 0.0),
        (Conditions(wetness=1.0), 0.0, 0.0),
        (Conditions(rain_mmph=15.0, visibility_m=2500.0), 0.002, 0.15),
        (Conditions(visibility_m=80.0), 0.3, 1.0),
    ],
)
def test_only_air_with_something_in_it_sends_beams_back(
    conditions: Conditions, low: float, high: float
) -> None:
    count = 5000
    range_m = np.full(count, 100.0, np.float32)
    returned, intensity = np.zeros(count, np.bool_), np.zeros(count, np.float32)
    chance = np.random.default_rng(2).random((count, 4), dtype=np.float32)
    of_air = air_returns(make_air(conditions), chance, 0.75, np.float32(100.0), range_m, returned, intensity)
    assert low <= of_air.mean() <= high
    assert (returned == of_air).all()
    assert (range_m[of_air] < 12.0).all()
    assert (intensity[of_air] < 0.2).all()
    assert (range_m[~of_air] == 100.0).all()


def test_a_strong_surface_outshines_the_air() -> None:
    count = 5000
    chance = np.random.default_rng(2).random((count, 4), dtype=np.float32)
    shares = []
    for strength in (0.01, 0.8):
        range_m, returned = np.full(count, 15.0, np.float32), np.ones(count, np.bool_)
        intensity = np.full(count, strength, np.float32)
        air = make_air(Conditions(visibility_m=150.0))
        shares.append(air_returns(air, chance, 0.75, np.float32(100.0), range_m, returned, intensity).mean())
    assert shares[1] < 0.2 * shares[0]


def test_overcast_has_no_sun() -> None:
    light = make_light(CONDITIONS["overcast"], 0.0)
    assert not light.sun.any()
    assert not light.sun_rgb.any()
    assert daylight_lux(CONDITIONS["overcast"]) < 0.4 * daylight_lux(CONDITIONS["clear"])


def test_lights_go_on_when_it_is_dark_or_hard_to_see() -> None:
    assert [n for n, c in CONDITIONS.items() if street_lamps_on(c)] == ["night", "night_rain", "night_fog"]
    assert {n for n, c in CONDITIONS.items() if headlights_on(c)} == {
        "dusk",
        "night",
        "rain",
        "night_rain",
        "fog",
        "night_fog",
    }


def light_at(xyz: tuple[float, float, float], normal: np.ndarray, T: np.ndarray, street: np.ndarray) -> float:
    """Green light of lamps, lux."""
    out = np.zeros(6, np.float32)
    lamps = gather_lamps(street, [], T)
    lamp_light(lamps, *xyz, *normal.tolist(), 0.0, 0.0, -1.0, 0.0, out)
    return float(out[1]) * UNIT_LUX


def test_lamps_shine_by_the_inverse_square_of_the_distance() -> None:
    T = np.eye(4)
    T[:2, 3] = 500.0  # the vehicle's own lights are far away
    lamp = np.array([[500.0, 480.0, 7.5]])
    below = light_at((500.0, 480.0, 0.0), DOWN, T, lamp)
    assert below == pytest.approx(0.8 * 3200.0 / 7.5**2, rel=1e-3)
    aside = light_at((507.5, 480.0, 0.0), DOWN, T, lamp)
    assert aside == pytest.approx(below / 2 / math.sqrt(2), rel=1e-3)  # twice the square, at 45°
    assert light_at((500.0, 480.0, 9.0), DOWN, T, lamp) == 0.0
    assert light_at((440.0, 480.0, 0.0), DOWN, T, lamp) == 0.0


def test_headlights_are_dipped_and_shine_ahead() -> None:
    none, towards = np.zeros((0, 3)), np.array([-1.0, 0.0, 0.0])
    low, high = (light_at((30.0, 0.0, z), towards, np.eye(4), none) for z in (0.1, 2.0))
    assert low > 10.0
    assert high < 0.1 * low
    assert light_at((30.0, 25.0, 0.1), towards, np.eye(4), none) < 0.1 * low
    assert light_at((-20.0, 0.0, 0.1), -towards, np.eye(4), none) < 0.1


def test_water_mirrors_more_at_a_glance() -> None:
    assert water_mirror(1.0) == pytest.approx(0.02)
    assert water_mirror(0.0) == pytest.approx(1.0)


def test_wet_roads_mirror_what_is_over_there() -> None:
    count, cosine = 400, 0.1
    direction = np.tile(np.array([math.sqrt(1 - cosine**2), 0.0, -cosine], np.float32), (count, 1))
    t, unlit = np.full(count, 10.0, np.float32), np.zeros(count, np.bool_)
    red = np.tile(np.array([0.8, 0.0, 0.0], np.float32), (count, 1))

    def road(wetness: float) -> np.ndarray:
        light = make_light(Conditions(clouds=1.0, wetness=wetness), 0.0)
        return shade(ROAD, met(count, DOWN, cosine), t, direction, unlit, light, red, NOT_KNOWN)

    dry, damp, flooded = (road(w) for w in (0.0, 0.4, 1.0))
    redness = [float((r[:, 0] - r[:, 1]).mean()) for r in (dry, damp, flooded)]
    assert redness[0] < 0.01 < redness[1] < redness[2]
    assert redness[2] < 0.8 * water_mirror(cosine) + 0.01
    assert damp[:, 1].mean() < 0.8 * dry[:, 1].mean()  # darker where it does not mirror


def test_streaks_and_drops_are_drawn_from_their_seeds() -> None:
    image = np.full((72, 128, 3), 80, np.uint8)
    image[:36] = 200
    rgb = np.full(3, 190, np.uint8)

    def rain(lens_seed: int, seed: int, rate: float = 20.0) -> np.ndarray:
        rng = np.random.default_rng(seed)
        return lens.add_rain(image, Conditions(rain_mmph=rate), 90.0, rgb, lens_seed, rng)

    assert rain(1, 1).tobytes() == rain(1, 1).tobytes()
    assert rain(1, 1).tobytes() != rain(1, 2).tobytes()
    assert rain(1, 1).tobytes() != rain(2, 1).tobytes()
    changed = [(rain(1, 3, rate) != image).any(-1).mean() for rate in (2.0, 60.0)]
    assert changed[0] < changed[1] < 0.9


@pytest.fixture(scope="module")
def sensors() -> SensorSuite:
    return SensorSuite(camera_rig((48, 80)), roof_lidar(16, 180))


@pytest.fixture(scope="module")
def under(world02: World, town02: TownMap, sensors: SensorSuite) -> dict[str, SensorFrame]:
    """The same place under each weather."""
    frames = {}
    for name in ("clear", "overcast", "night", "rain", "night_rain", "fog"):
        town = world02.under(find_conditions(name))
        frames[name] = town.render([], sensors, ego_pose(town02), STILL, noise_seed=5)
    return frames


def brightness(frame: SensorFrame) -> float:
    return float(np.mean([image.mean() for image in frame.images.values()]))


def test_night_is_darker_than_day_but_not_black(under: dict[str, SensorFrame]) -> None:
    assert 15.0 < brightness(under["night"]) < 0.7 * brightness(under["clear"])
    ahead = under["night"].images["PCAM_F0"]
    assert ahead[-12:, 30:50].mean() > 40.0  # the road in the headlights


def test_only_the_sun_casts_shadows(world02: World, town02: TownMap, sensors: SensorSuite) -> None:
    T = ego_pose(town02)
    roof = actor_at(T, (0.0, 0.0, 60.0), size_lwh=np.array([150.0, 150.0, 0.5]))

    def road(conditions: str, *actors: ActorState) -> float:
        frame = world02.under(find_conditions(conditions)).render(list(actors), sensors, T, STILL, 0)
        return float(frame.images["PCAM_F0"][-10:].mean())

    assert road("clear", roof) < 0.75 * road("clear")
    assert road("overcast", roof) == road("overcast")


def test_fog_takes_contrast_and_sends_beams_back(under: dict[str, SensorFrame]) -> None:
    assert under["fog"].images["PCAM_F0"].std() < 0.7 * under["overcast"].images["PCAM_F0"].std()
    sweep, clear = under["fog"].sweep, under["clear"].sweep
    early = (sweep.range_m < 0.8 * clear.range_m) & sweep.returned
    assert early.float().mean() > 0.05
    assert (under["fog"].beam_ids[early.numpy()] == NO_ACTOR).all()


def test_rain_changes_beams_and_road(under: dict[str, SensorFrame]) -> None:
    ground = under["clear"].beam_surface == Surface.ROAD
    far = ground & (under["clear"].sweep.range_m.numpy() > 8.0)
    dry, wet = (under[n].sweep.returned.numpy()[far].mean() for n in ("clear", "rain"))
    assert wet < dry


def test_the_same_weather_gives_the_same_bytes(
    world02: World, town02: TownMap, sensors: SensorSuite, under: dict[str, SensorFrame]
) -> None:
    town = world02.under(find_conditions("night_rain"))
    again = town.render([], sensors, ego_pose(town02), STILL, noise_seed=5)
    first = under["night_rain"]
    assert all(first.images[name].tobytes() == image.tobytes() for name, image in again.images.items())
    assert first.sweep.range_m.numpy().tobytes() == again.sweep.range_m.numpy().tobytes()


def test_beams_in_fog_are_seen_from_aside_and_scatter_all_that_they_lose() -> None:
    share, _ = quad(lambda cosine: 2.0 * math.pi * phase(cosine), -1.0, 1.0)
    assert share == pytest.approx(1.0)
    assert phase(-1.0) == pytest.approx(BACKSCATTER_RATIO, rel=0.02)
    extinction = 0.03
    T = np.eye(4)
    T[:2, 3] = 500.0
    lamps = gather_lamps(np.array([[500.0, 480.0, 7.5]]), [], T)
    start = np.array([[500.0, 470.0, 4.0], [500.0, 470.0, 12.0]], np.float32)  # below the lamp, above it
    ahead = np.tile(np.array([[0.0, 1.0, 0.0]], np.float32), (2, 1))
    seen = np.zeros((2, 3), np.float32)
    add_beams(lamps, extinction, np.full(2, 20.0, np.float32), start, ahead, NOT_KNOWN, seen)
    assert not seen[1].any()

    def gathered(s: float) -> float:
        """Of the light of the lamp, by the radiance of a white surface, on the metre at s."""
        y, z = s - 10.0, -3.5
        r = math.hypot(y, z)
        sent = min(max(5.0 * (-z / r - 0.2), 0.0), 1.0) * 0.8 * 3200.0 / UNIT_LUX
        return math.pi * extinction * sent * phase(-y / r) * math.exp(-extinction * (s + r)) / r**2

    aside = MAX_LATERAL_M[0] * math.exp(-extinction * 10.0)
    faded = 1.0 - (3.5 / aside) ** 2
    assert seen[0, 1] == pytest.approx(faded * quad(gathered, 0.0, 20.0)[0], rel=0.05)
