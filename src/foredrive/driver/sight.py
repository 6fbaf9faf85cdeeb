"""What a driver sees of its route, and the head that reads it from image features."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from foredrive.driver.road_user_targets import USERS
from foredrive.driver.route_cells import BESIDE_M, LINE_BESIDE_M, LINE_CELL_M, LINE_CELLS, route_cells
from foredrive.scene import Clip
from foredrive.scene.affordances import CELL_M, CELLS, HALF_WIDTH_M, LATER_DT_S, TIMES, PathEstimate
from foredrive.scene.clip import ROUTE_M
from foredrive.scene.record import Record
from foredrive.scene.traffic_light import LightState

COLOURS = (LightState.RED, LightState.YELLOW, LightState.GREEN)
CONTEXT = 64
ROUTE_SCALE_M, VELOCITY_SCALE_MPS = 20.0, 5.0
FADES_M = 1.5
"""Distance beyond half the width of the path over which a road user beside it counts less, m."""
RARE_LOGIT, NONE_LOGIT, NO_SIGN_LOGIT = -4.0, -2.0, 20.0
LIGHT_SCALE_M, LINE_BEFORE_LAMP_M = 20.0, 4.0
"""Scale of a stop line's distance as it is read at a lamp, where the line is not seen: log((m + 4) / 20)."""


@dataclass(frozen=True)
class Sight(Record):
    """Logits of what is on the route. `PathEstimate` holds the probabilities."""

    light_logits: Float[Tensor, "b 4"]
    """Of each `LightState`: for NONE of the whole, for the others the largest of `lamp_logits`."""
    lamp_logits: Float[Tensor, "b C 3 h w"]
    """Whether a red, yellow or green lamp of the light on the route is at a place of an image."""
    lamp_line: Float[Tensor, "b C h w"]
    """The distance of the stop line as it is read at each place: log((m + 4) / 20)."""
    line_logits: Float[Tensor, f"b {LINE_CELLS + 1}"]
    """Logits of the stop line of the next light in each of the `LINE_CELLS`, and of none in any."""
    sign_logits: Float[Tensor, f"b {LINE_CELLS + 1}"]
    """The same of the next stop sign."""
    occupied_logits: Float[Tensor, "b T G"]
    user_pixels: Float[Tensor, "b C K h w"]
    """Logits of a road user of each kind at each place of an image. They are used in training only, so that
    the features contain where road users are."""
    user_cells: Float[Tensor, "b U G L"]
    """The same for the cells along and beside the route; then the velocity along the route and to its left,
    in `VELOCITY_SCALE_MPS`."""

    @property
    def line_seen(self) -> Bool[Tensor, "b"]:
        """Return whether the stop line is seen on the ground, in one place."""
        return _likeliest(self.line_logits)[1] > 0.5

    @property
    def light_m(self) -> Float[Tensor, "b"]:
        """Return the distance of the stop line, m: seen on the ground, or else read at the likeliest lamp."""
        at_lamp = self.lamp_logits.amax(2).flatten(1).argmax(1, keepdim=True)
        far_m = line_m(self.lamp_line.flatten(1).gather(1, at_lamp)[:, 0])
        near_m, probability = _likeliest(self.line_logits)
        return torch.where(probability > 0.5, near_m, far_m)

    @property
    def sign_m(self) -> Float[Tensor, "b"]:
        """Return the distance of the line of the next stop sign, m; infinite where none is seen."""
        near_m, probability = _likeliest(self.sign_logits)
        return torch.where(probability > 0.5, near_m, torch.inf)

    def estimate(self) -> PathEstimate:
        """Return probabilities and distances."""
        return PathEstimate(self.light_logits.softmax(-1), self.light_m, self.occupied_logits.sigmoid())


def _likeliest(
    logits: Float[Tensor, f"b {LINE_CELLS + 1}"],
) -> tuple[Float[Tensor, "b"], Float[Tensor, "b"]]:
    """Return the likeliest place of a line, m, and how probable it is in its cell and those beside it."""
    cells = F.pad(logits.softmax(-1)[:, :-1], (1, 1))
    likeliest = cells[:, 1:-1].argmax(1, keepdim=True)
    near = cells.gather(1, likeliest + torch.arange(3, device=cells.device))
    # The mean of the likeliest cell and its neighbours
    offset = (near[:, 2] - near[:, 0]) / near.sum(1).clamp_min(1e-6)
    return LINE_CELL_M * (likeliest[:, 0] + 0.5 + offset), near.sum(1)


def line_m(scaled: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Return the distance of a stop line, m, of a number as in `Sight.lamp_line`."""
    # Logarithmic scale from some metres before the line: errors near the line count more
    return LIGHT_SCALE_M * scaled.clamp(-3, 2).exp() - LINE_BEFORE_LAMP_M


def scaled_line(light_m: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Return the inverse of `line_m`."""
    return ((light_m + LINE_BEFORE_LAMP_M).clamp_min(1.0) / LIGHT_SCALE_M).log()


class RouteReader(nn.Module):
    """Reads the route from features of any eyes: who is on it, and its light.

    The speed is no input: a standing vehicle mostly stands at a red light, so the head would infer red from
    standing.

    Args:
        cells: channels of the features in the cells along and beside the route.
        ground: channels of the features of the ground along the route.
        fine: channels of the fine image features, in which lamps are read.
        wide: channels of the features whose mean tells that there is no light.
        cameras: number of cameras.
        signs: whether stop signs are read.
    """

    def __init__(
        self, cells: int, ground: int, fine: int, wide: int, cameras: int, *, signs: bool = False
    ) -> None:
        super().__init__()
        self.context = nn.Sequential(
            nn.Linear(3 * len(ROUTE_M), CONTEXT), nn.ReLU(), nn.Linear(CONTEXT, CONTEXT), nn.ReLU()
        )
        self.lamps = LampHead(fine, wide, CONTEXT, cameras)
        self.line = LineHead(ground, CONTEXT)
        self.occupancy = OccupancyHead(cells + 3)
        # Biases for rare events: training begins with small probabilities
        self.users = nn.Conv2d(fine, len(USERS), 1)
        assert self.users.bias is not None
        nn.init.constant_(self.users.bias, RARE_LOGIT)
        self.signs = SignHead(fine, ground, CONTEXT) if signs else None

    def forward(
        self,
        clip: Clip,
        cells: Float[Tensor, "b F G L"],
        ground: Float[Tensor, "b E N S"],
        fine: Float[Tensor, "b C K h w"],
        mean: Float[Tensor, "b C W"],
    ) -> Sight:
        """Return what is on the route.

        Args:
            clip: its route is read.
            cells: features in the cells of `route_cells`.
            ground: features in the cells of `line_cells`, at now.
            fine: image features at now.
            mean: mean image features at now.
        """
        route = clip.route_xy / ROUTE_SCALE_M
        route = torch.cat([route, clip.route_valid[..., None].to(route)], dim=-1)
        context = self.context(route.flatten(1))
        light, lamps, lines = self.lamps(fine, mean, context)
        line = self.line(ground, context)
        # Eyes that do not know signs see none
        sign = torch.zeros_like(line)
        sign[:, -1] = NO_SIGN_LOGIT
        if self.signs is not None:
            sign = self.signs(fine, ground, context)
        # Where each cell is: its place, and its distance beside the route
        middles = route_cells(clip.route_xy, clip.route_valid)
        place = torch.cat(
            [
                middles.permute(0, 3, 1, 2) / ROUTE_SCALE_M,
                middles.new_tensor(BESIDE_M).div(10.0).expand(len(middles), 1, *middles.shape[1:3]),
            ],
            dim=1,
        )
        occupied, user_cells = self.occupancy(torch.cat([cells.to(place), place], dim=1))
        pixels = self.users(fine.flatten(0, 1)).unflatten(0, fine.shape[:2])
        return Sight(light, lamps, lines, line, sign, occupied, pixels.float(), user_cells)


class LampReading(NamedTuple):
    """Holds what lamps show, as parts of `Sight`."""

    light_logits: Float[Tensor, "b 4"]
    lamp_logits: Float[Tensor, "b C 3 h w"]
    lamp_line: Float[Tensor, "b C h w"]


class LampHead(nn.Module):
    """Reads lamps at every place of fine image features, given the route.

    The largest logit of each colour over all places decides, so that a few pixels count as much as a wall.

    Args:
        channels: channels of the fine features of each of C cameras.
        wide: channels of features whose mean tells that there is no light.
        context: length of the vector of the route.
        cameras: C.
        hidden: width.
    """

    def __init__(self, channels: int, wide: int, context: int, cameras: int, hidden: int = 48) -> None:
        super().__init__()
        self.read = nn.ModuleList([nn.Conv2d(channels + 2, hidden, 1) for _ in range(cameras)])
        self.scale = nn.ModuleList([nn.Linear(context, hidden) for _ in range(cameras)])
        self.shift = nn.ModuleList([nn.Linear(context, hidden) for _ in range(cameras)])
        self.lamps = nn.ModuleList([_lamp_layers(hidden) for _ in range(cameras)])
        self.none = nn.Linear(context + cameras * wide, 1)
        nn.init.constant_(self.none.bias, NONE_LOGIT)

    def forward(
        self, fine: Float[Tensor, "b C F h w"], mean: Float[Tensor, "b C W"], context: Float[Tensor, "b V"]
    ) -> LampReading:
        """Return what the lamps show."""
        b, _, _, h, w = fine.shape
        y, x = torch.meshgrid(torch.linspace(-1, 1, h), torch.linspace(-1, 1, w), indexing="ij")
        place = torch.stack([x, y]).to(fine).expand(b, 2, h, w)
        maps = []
        for c, (read, scale, shift, lamps) in enumerate(
            zip(self.read, self.scale, self.shift, self.lamps, strict=True)
        ):
            # The route scales and shifts the features (FiLM), so that lamps are read for this route
            features = read(torch.cat([fine[:, c], place], dim=1))
            gated = features * (1 + scale(context))[..., None, None] + shift(context)[..., None, None]
            maps.append(lamps(gated.relu()))
        maps_of_all = torch.stack(maps, dim=1).float()
        none = self.none(torch.cat([context, mean.flatten(1)], dim=-1)).float()
        # Maximum over places and cameras: each colour's best lamp
        lamps_logits = maps_of_all[:, :, : len(COLOURS)]
        colours = lamps_logits.flatten(3).amax(-1).amax(1)
        return LampReading(torch.cat([none, colours], dim=-1), lamps_logits, maps_of_all[:, :, len(COLOURS)])


def _lamp_layers(hidden: int) -> nn.Sequential:
    last = nn.Conv2d(32, len(COLOURS) + 1, 1)
    assert last.bias is not None
    nn.init.constant_(last.bias[: len(COLOURS)], RARE_LOGIT - 1)
    return nn.Sequential(nn.Conv2d(hidden, 32, 3, padding=1), nn.ReLU(), last)


class LineHead(nn.Module):
    """Reads where the stop line of the next light crosses the route, from features of the ground.

    Lamps do not tell: they hang 10 to 35 m beyond the line, across the junction. Frames before now are not
    read: they show whether the vehicle stands, and who stands mostly stands at a line.

    Args:
        channels: channels of each cell.
        context: length of the vector of the route.
        width: width of the convolutions along the route.
    """

    def __init__(self, channels: int, context: int, width: int = 48) -> None:
        super().__init__()
        self.ground = nn.Conv1d(channels * len(LINE_BESIDE_M) + 1, width, 1)
        # Each layer sees twice as far along the route as that before; all together 29 m
        self.along = nn.Sequential(
            nn.ReLU(),
            *(
                layer
                for dilation in (1, 2, 4)
                for layer in (
                    nn.Conv1d(width, width, 5, padding=2 * dilation, dilation=dilation),
                    nn.ReLU(),
                )
            ),
        )
        self.line = nn.Conv1d(width, 1, 1)
        self.none = nn.Linear(width + context, 1)

    def forward(
        self, ground: Float[Tensor, "b E N S"], context: Float[Tensor, "b V"]
    ) -> Float[Tensor, f"b {LINE_CELLS + 1}"]:
        """Return `Sight.line_logits`."""
        # What lies beside the route at one distance becomes channels; one more is the distance
        columns = ground.permute(0, 1, 3, 2).flatten(1, 2)
        place = torch.linspace(-1, 1, columns.shape[-1]).to(columns).expand(len(columns), 1, -1)
        features = self.along(self.ground(torch.cat([columns, place], dim=1)))
        none = self.none(torch.cat([features.amax(-1), context], dim=-1))
        return torch.cat([self.line(features)[:, 0], none], dim=-1).float()


class SignHead(nn.Module):
    """Reads where the stop line of the next stop sign crosses the route.

    The line looks like that of a light, so plates in the images are read too.

    Args:
        channels: channels of the fine image features.
        ground: channels of each cell of the ground.
        context: length of the vector of the route.
        plates: number of features of plates.
    """

    def __init__(self, channels: int, ground: int, context: int, plates: int = 16) -> None:
        super().__init__()
        self.plates = nn.Sequential(
            nn.Conv2d(channels, 32, 1), nn.ReLU(), nn.Conv2d(32, plates, 3, padding=1), nn.ReLU()
        )
        self.line = LineHead(ground, context + plates)
        nn.init.constant_(self.line.none.bias, -RARE_LOGIT)

    def forward(
        self,
        fine: Float[Tensor, "b C K h w"],
        ground: Float[Tensor, "b E N S"],
        context: Float[Tensor, "b V"],
    ) -> Float[Tensor, f"b {LINE_CELLS + 1}"]:
        """Return `Sight.sign_logits`."""
        # The clearest plate in any image, so that few pixels count as much as a wall
        plates = self.plates(fine.flatten(0, 1)).flatten(2).amax(-1).unflatten(0, fine.shape[:2]).amax(1)
        return self.line(ground, torch.cat([context, plates], dim=-1))


class OccupancyHead(nn.Module):
    """Reads who is on the route, and will be, from features in the cells along and beside it.

    Convolutions in the plane of the cells find road users and their velocities (`Sight.user_cells`).
    Convolutions along the route alone then read the plane, and where these road users would be on the route
    if they went on at constant velocity.

    Args:
        channels: channels of each cell.
        width: width of the convolutions.
    """

    def __init__(self, channels: int, width: int = 64) -> None:
        super().__init__()
        self.cells = nn.Conv2d(channels, width, 1)
        self.plane = nn.Sequential(nn.ReLU(), *(conv_block(width, width, stride=1) for _ in range(3)))
        self.users = nn.Conv2d(width, len(USERS) + 2, 1)
        assert self.users.bias is not None
        nn.init.constant_(self.users.bias[: len(USERS)], RARE_LOGIT + 1)
        last = nn.Conv1d(width, TIMES, 1)
        assert last.bias is not None
        nn.init.constant_(last.bias, RARE_LOGIT + 1.5)
        self.route = nn.Sequential(
            nn.Conv1d(width * len(BESIDE_M) + TIMES, 96, 1),
            nn.ReLU(),
            nn.Dropout(0.1),
            nn.Conv1d(96, width, 3, padding=1),
            nn.ReLU(),
            last,
        )

    def forward(
        self, cells: Float[Tensor, "b F G L"]
    ) -> tuple[Float[Tensor, f"b {TIMES} {CELLS}"], Float[Tensor, "b U G L"]]:
        """Return the logits of occupancy, and `Sight.user_cells`."""
        plane = self.plane(self.cells(cells))  # [b F G L]
        users = self.users(plane).float()
        # The plane's columns beside the route become channels along it
        ahead = occupied_at_constant_velocity(users).to(plane)
        logits: Tensor = self.route(torch.cat([plane.permute(0, 1, 3, 2).flatten(1, 2), ahead], dim=1))
        return logits.float(), users


def occupied_at_constant_velocity(users: Float[Tensor, "b U G L"]) -> Float[Tensor, f"b {TIMES} G"]:
    """Return how probably road users would be on the route at each time if they went on as they move.

    Args:
        users: as `Sight.user_cells`.
    """
    b, _, along, _ = users.shape
    # Probability that any kind is in the cell
    kinds = len(USERS)
    probability = users[:, :kinds].sigmoid().amax(1)
    # Positions along the route, in cells, and beside it, in metres, of what each cell holds.
    velocity = VELOCITY_SCALE_MPS * users[:, kinds:]
    t_s = LATER_DT_S * torch.arange(TIMES, device=users.device)[:, None, None]
    first = torch.arange(along, device=users.device)[:, None]
    cell = (first + velocity[:, None, 0] * t_s / CELL_M).round().long()
    # Weight of a road user beside the path: 1 within half its width, fading to 0 over some distance
    beside_m = users.new_tensor(BESIDE_M) + velocity[:, None, 1] * t_s
    in_way = (1 - (beside_m.abs() - HALF_WIDTH_M) / FADES_M).clamp(0, 1)
    weight = probability[:, None] * in_way * ((cell >= 0) & (cell < along))
    # Of several road users that reach one cell, the most probable counts
    occupied = users.new_zeros(b, TIMES, along)
    return occupied.scatter_reduce(2, cell.clamp(0, along - 1).flatten(2), weight.flatten(2), "amax")


def conv_block(inputs: int, outputs: int, size: int = 3, stride: int = 2) -> nn.Sequential:
    """Return a convolution with batch normalisation and ReLU."""
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, size, stride, size // 2, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )
